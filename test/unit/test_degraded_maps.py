"""Degraded maps: what is done to the Gaussians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from map_files import ARRAYS
from room_datasets import write_nerfstudio

from gsfeatloc_ros.common.geometry import invert, so3_exp, transform
from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.evaluate.degradations import DEGRADATIONS, degrade
from gsfeatloc_ros.evaluate.protocol import trajectory_radius
from gsfeatloc_ros.evaluate.scene import load_degraded_renderer, load_scene, load_scene_renderer
from gsfeatloc_ros.localize.settings import RendererSettings
from gsfeatloc_ros.maps import GaussianMap, load_map
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.simulate import simulate_photos


@pytest.fixture(scope="module")
def scene(tmp_path_factory, room, room_camera, room_map_file) -> Scene:
    camera = room_camera.scaled(160, 120)
    folder = tmp_path_factory.mktemp("room")
    return load_scene(write_nerfstudio(folder, camera, simulate_photos(room, camera, count=2, seed=5), room_map_file))


@pytest.fixture(scope="module")
def map_(scene) -> GaussianMap:
    return load_map(scene.map_path)


@pytest.mark.parametrize("name", DEGRADATIONS)
def test_degraded_maps_are_maps_and_the_same_again(name, map_, scene):
    kept = {array: getattr(map_, array).copy() for array in ARRAYS}
    degraded, again, other = (degrade(name, map_, scene, seed) for seed in (1, 1, 2))
    for array in ARRAYS:
        np.testing.assert_array_equal(getattr(map_, array), kept[array])
        values = getattr(degraded, array)
        assert values.dtype == np.float32
        assert values.shape[0] == len(degraded)
        assert np.isfinite(values).all()
        np.testing.assert_array_equal(values, getattr(again, array))
    assert (degraded.scales > 0).all()
    np.testing.assert_allclose(np.linalg.norm(degraded.rotations, axis=1), 1, atol=1e-4)
    assert ((degraded.opacities >= 0) & (degraded.opacities <= 1)).all()
    by_chance = len(other) != len(degraded) or not np.array_equal(other.means, degraded.means)
    assert by_chance == (name not in ("grown", "sh0"))


def test_three_of_ten_are_dropped_and_all_are_grown(map_, scene):
    assert len(degrade("dropped", map_, scene, 0)) == pytest.approx(0.7 * len(map_), rel=0.05)
    np.testing.assert_allclose(degrade("grown", map_, scene, 0).scales, 1.3 * map_.scales, rtol=1e-6)
    np.testing.assert_array_equal(degrade("sh0", map_, scene, 0).sh, map_.sh[:, :1])


@pytest.mark.parametrize(("name", "count"), [("floaters", 3000), ("haze", 110)])
def test_floaters_and_haze_hang_before_the_cameras(name, count, map_, scene):
    # Also in a map that lies otherwise in the map frame, and has another unit.
    moved = replace(map_, S_map_splat=Similarity(2.0, so3_exp(np.array([0.3, 0.2, 0.1])), np.array([1.0, -2.0, 3.0])))
    for given in (map_, moved):
        degraded = degrade(name, given, scene, 0)
        assert len(degraded) == len(given) + count
        np.testing.assert_array_equal(degraded.means[: len(given)], given.means)
        added = given.S_map_splat.transform(degraded.means[len(given) :])
        radius, camera = trajectory_radius(scene), scene.camera
        seen = np.zeros(count, bool)
        for pose in scene.trajectory:
            points = transform(invert(pose), added)
            pixels = camera.pinhole().project(points)
            inside = ((pixels > -1) & (pixels < [camera.width, camera.height])).all(axis=1)
            seen |= inside & (points[:, 2] > 0.09 * radius) & (points[:, 2] < 0.51 * radius)
        assert seen.all()


def test_a_bend_is_small_and_smooth(map_, scene):
    shift = degrade("bent-0.5", map_, scene, 0).means.astype(np.float64) - map_.means
    width = 2 * trajectory_radius(scene)
    assert np.sqrt(np.mean(np.sum(shift**2, axis=1))) == pytest.approx(0.005 * width, rel=0.5)
    # Neighbours move together: across a twentieth of the width, by less than a third of the amplitude.
    near = np.linalg.norm(map_.means - map_.means[0], axis=1) < 0.05 * width
    assert near.sum() > 10
    assert np.linalg.norm(shift[near] - shift[0], axis=1).max() < 0.5 * 0.005 * width
    # And it bends: not all move alike.
    assert shift.std(axis=0).max() > 0.001 * width


def test_a_degraded_map_is_drawn(map_, scene):
    pose = scene.photos[0].T_map_camera
    whole = load_scene_renderer(scene, RendererSettings()).render(scene.camera, pose)

    def drawn(degrade_):
        return load_degraded_renderer(scene, RendererSettings(), degrade_).render(scene.camera, pose)

    np.testing.assert_array_equal(drawn(lambda given: given).rgb, whole.rgb)
    hazy = drawn(lambda given: degrade("haze", given, scene, 0))
    assert np.abs(hazy.rgb - whole.rgb).mean() > 0.01
