"""What is found out about a map: of the simulated room, of which everything is known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from room_datasets import write_nerfstudio
from small_maps import concatenated, one_gaussian

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion, so3_exp
from gsfeatloc_ros.evaluate.degradations import degrade
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.index.placement import radius
from gsfeatloc_ros.inspect.floaters import find_floaters, floating
from gsfeatloc_ros.inspect.frame import upright_parameters
from gsfeatloc_ros.inspect.looks import look_around
from gsfeatloc_ros.inspect.photos import aligned_psnr, fit_photos
from gsfeatloc_ros.inspect.statistics import describe_gaussians
from gsfeatloc_ros.inspect.surfaces import Surfaces, find_surfaces
from gsfeatloc_ros.inspect.unit import find_unit
from gsfeatloc_ros.inspect.upright import Upright, find_upright
from gsfeatloc_ros.localize.settings import MapSettings, RendererSettings
from gsfeatloc_ros.maps import GaussianMap, Similarity
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.simulate import SimulatedPhoto, cover, simulate_photos
from gsfeatloc_ros.tools import inspect

# A turn about no axis in particular.
TURN = so3_exp(np.array([0.9, -1.3, 0.6]))
CPU = RendererSettings("cpu", 1)
MOVED = Similarity(rotation=TURN, translation=np.array([5.0, 1.0, -2.0]))


@pytest.fixture(scope="module")
def coarse_map(room) -> GaussianMap:
    """The room in a quarter of the Gaussians."""
    return cover(room, 0.056)


@pytest.fixture(scope="module")
def looks(coarse_map):
    return look_around(create_renderer(coarse_map, "cpu", 1), 200)


def angle_deg(a, b) -> float:
    return float(np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1))))


def test_the_rooms_up_floor_ceiling_and_unit_are_found(coarse_map, looks):
    found = find_upright(find_surfaces(looks, radius(coarse_map.means)))
    assert found.sure
    assert angle_deg(found.up, [0, 0, 1]) < 2
    assert found.floor == pytest.approx(0.0, abs=0.06)
    assert found.ceiling == pytest.approx(3.0, abs=0.06)
    assert find_unit(found.floor, found.ceiling, None).may_be_metre


def test_up_is_found_however_the_room_is_turned(coarse_map, looks):
    surfaces = find_surfaces(looks, radius(coarse_map.means))
    rng = np.random.default_rng(0)
    for _ in range(3):
        turn = so3_exp(rng.uniform(-3, 3, 3))
        found = find_upright(Surfaces(surfaces.points @ turn.T, surfaces.normals @ turn.T))
        assert found.sure
        assert angle_deg(found.up, turn[:, 2]) < 2


def test_a_map_that_is_turned_is_set_upright_by_the_parameters_named(coarse_map):
    placed = coarse_map.placed(MOVED)
    around = look_around(create_renderer(placed, "cpu", 1), 200, seed=1)
    found = find_upright(find_surfaces(around, radius(coarse_map.means)))
    assert angle_deg(found.up, TURN[:, 2]) < 2
    named = upright_parameters(found, MOVED)
    again = Similarity(
        rotation=matrix_from_quaternion(named["map.rotation"]), translation=np.array(named["map.translation"])
    )
    # Of the frame of the file z is up, and the floor at 0.
    assert angle_deg(again.rotation[:, 2], [0, 0, 1]) < 2
    assert again.transform(np.zeros((1, 3)))[0, 2] == pytest.approx(0.0, abs=0.2)


@given(vector=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1), floor=st.floats(-5, 5))
@settings(max_examples=50)
def test_any_up_is_turned_to_z_and_the_floor_to_zero(vector, floor):
    up = np.array(vector) / np.linalg.norm(vector)
    upright = Upright(up.tolist(), 0.5, 0.9, True, floor, None)
    named = upright_parameters(upright, Similarity())
    rotation = matrix_from_quaternion(named["map.rotation"])
    np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=1e-5)
    assert (rotation @ (floor * up) + named["map.translation"])[2] == pytest.approx(0, abs=1e-4)


def test_of_nothing_and_of_a_ball_no_up_is_claimed():
    assert find_upright(Surfaces(np.empty((0, 3)), np.empty((0, 3)))) is None
    normals = np.random.default_rng(0).normal(size=(5000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert not find_upright(Surfaces(normals, normals)).sure


def test_a_floor_alone_is_no_metre():
    assert find_unit(None, None, 1.5) is None
    assert find_unit(0.0, None, None) is None
    assert not find_unit(0.0, 26.0, None).may_be_metre
    assert find_unit(0.0, None, 1.2).may_be_metre


@pytest.fixture(scope="module")
def scene(tmp_path_factory, room, room_camera, coarse_map):
    folder = tmp_path_factory.mktemp("scene")
    write_ply(folder / "coarse.ply", coarse_map)
    photos = simulate_photos(room, room_camera.scaled(160, 120), count=2, seed=5)
    return load_scene(write_nerfstudio(folder, room_camera.scaled(160, 120), photos, folder / "coarse.ply"))


def test_floaters_that_were_put_in_are_counted_and_no_others(coarse_map, looks, scene):
    assert find_floaters(coarse_map, looks, CPU).share < 0.001
    degraded = degrade("floaters", coarse_map, scene, seed=0)
    around = look_around(create_renderer(degraded, "cpu", 1), 400)
    added = len(degraded) - len(coarse_map)
    assert 0.7 * added < find_floaters(degraded, around, CPU).count < 1.05 * added


def test_nothing_floats_where_nothing_is_seen():
    assert not floating(np.zeros((3, 3)), []).any()
    assert find_floaters(one_gaussian((0, 0, 1), 0.1, 0.9), [], CPU).count == 0


def test_statistics_are_of_the_map_frame():
    two = concatenated(one_gaussian((0, 0, 1), 0.1, 0.9), one_gaussian((0, 0, 3), 0.01, 0.2))
    found = describe_gaussians(two.placed(Similarity(scale=2.0)))
    assert found.count == 2
    assert found.solid == 0.5
    assert (found.low[2], found.high[2]) == (2.0, 6.0)
    assert sum(found.opacity.counts) == sum(found.scale.counts) == 2
    assert 10 ** found.scale.edges[-1] == pytest.approx(0.2, rel=1e-4)


@given(gain=st.floats(0.5, 1.0), offset=st.floats(0.0, 0.2))
@settings(max_examples=20)
def test_exposure_does_not_count_and_noise_does(gain, offset):
    rng = np.random.default_rng(0)
    render = rng.uniform(0, 0.8, (4000, 3))
    photo = gain * render + offset
    assert aligned_psnr(photo, render) > 90
    assert aligned_psnr(photo + rng.normal(0, 0.1, photo.shape), render) == pytest.approx(20, abs=0.5)


@pytest.mark.parametrize("antialiased", [True, False])
def test_photos_tell_whether_a_map_was_trained_antialiased(antialiased, coarse_map, tmp_path):
    """Photos that are renders of it, of a file that says nothing, or the contrary."""
    camera = Camera(160, 120, np.array([[120.0, 0, 79.5], [0, 120.0, 59.5], [0, 0, 1]]), np.zeros(5))
    poses = [make_pose(so3_exp(np.array([0.0, 0, turn])) @ LEVEL, [0.5, 1.0, 1.5]) for turn in (0.0, 1.5, 3.0)]
    renderer = create_renderer(replace(coarse_map, antialiased=antialiased), "cpu", 1)
    photos = [SimulatedPhoto(0.0, renderer.render(camera, pose).image(), pose, pose) for pose in poses]
    write_ply(tmp_path / "said.ply", replace(coarse_map, antialiased=not antialiased))
    folder = write_nerfstudio(tmp_path, camera, photos, tmp_path / "said.ply")
    read = MapSettings(path=str(folder / "map.ply"))
    fit = fit_photos(load_scene(folder), read, CPU, is_spz=False, max_width=1000)
    (comparison,) = fit.comparisons
    assert comparison.parameter == "map.antialiased"
    assert comparison.better == str(antialiased).lower()
    assert comparison.psnr[antialiased] > comparison.psnr[not antialiased] + 3


# From the axes of a level camera that looks along x to the map's.
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def test_the_tool_writes_text_json_and_a_page(coarse_map, tmp_path, capsys):
    write_ply(tmp_path / "room.ply", coarse_map)
    files = {name: tmp_path / f"room.{name}" for name in ("json", "html")}
    arguments = [
        str(tmp_path / "room.ply"),
        *(word for name, path in files.items() for word in (f"--{name}", str(path))),
    ]
    assert inspect.main([*arguments, "--threads", "1"]) == 0
    text = capsys.readouterr().out
    assert f"Gaussians       {len(coarse_map):,}," in text
    assert "nothing looks wrong" in text
    content = json.loads(files["json"].read_text())
    assert content["statistics"]["count"] == len(coarse_map)
    assert content["upright"]["sure"] is True
    page = files["html"].read_text()
    assert page.count("data:image/jpeg;base64,") == content["quality"]["views"] == 12
    assert "http" not in page.replace("http://www.w3.org", "")


def test_a_map_of_one_gaussian_is_inspected(tmp_path, capsys):
    write_ply(tmp_path / "one.ply", one_gaussian((0, 0, 1), 0.1, 0.9))
    assert inspect.main([str(tmp_path / "one.ply"), "--threads", "1"]) == 0
    assert "looks wrong: It has 1 Gaussians" in capsys.readouterr().out
