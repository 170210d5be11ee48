"""The tool that measures: that it runs, and that what it says is of what was asked."""

from __future__ import annotations

import json
import mmap
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from room_datasets import write_nerfstudio

from gsfeatloc_ros.benchmark.frames import pinhole, view_of_all
from gsfeatloc_ros.benchmark.index_scaling import draw_index, measure_index
from gsfeatloc_ros.benchmark.measure import memory_taken, spread, timed
from gsfeatloc_ros.benchmark.opensplat import measure_against_opensplat
from gsfeatloc_ros.benchmark.scaling import draw_scaling, measure_scaling
from gsfeatloc_ros.benchmark.twins import twins_table
from gsfeatloc_ros.common.geometry import invert, quaternion_from_matrix, transform
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.simulate import simulate_photos
from gsfeatloc_ros.simulate.two_rooms import VIEWS, two_rooms
from gsfeatloc_ros.tools import benchmark


@pytest.fixture(scope="module")
def map_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("two_rooms") / "map.ply"
    assert benchmark.main(["synthetic", "--gaussians", "20000", "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory, room, room_camera, room_map_file) -> Path:
    camera = room_camera.scaled(320, 240)
    photos = simulate_photos(room, camera, count=2, seed=5)
    return write_nerfstudio(tmp_path_factory.mktemp("room"), camera, photos, room_map_file)


def measured(tmp_path: Path, *arguments: object) -> dict:
    path = tmp_path / "figures.json"
    assert benchmark.main([*map(str, arguments), "--json", str(path)]) == 0
    return json.loads(path.read_text())


def share_in_view(means: np.ndarray, pose: np.ndarray) -> float:
    """Share of the Gaussians whose centres a camera of 640x480 has in its picture."""
    camera = pinhole((640, 480))
    points = transform(invert(pose), means.astype(np.float64))
    pixels = camera.project(points)
    return np.mean((points[:, 2] > 0) & (np.abs(pixels - [319.5, 239.5]) <= [320, 240]).all(axis=1))


def test_time_and_memory_are_those_of_the_block():
    # Threads of earlier work may go on spinning for a moment, on all cores.
    time.sleep(0.5)
    slept = timed(time.sleep, 0.1)
    assert slept.wall >= 100
    assert slept.cpu < 50
    with memory_taken() as memory:
        # Pages of the system's own: what malloc gives may have been there before.
        kept = touched(40)
        touched(80).close()
    assert 119 < memory.peak < 134
    assert 39 < memory.after < 60
    kept.close()


def touched(megabytes: int) -> mmap.mmap:
    """Memory that is all in use."""
    pages = mmap.mmap(-1, megabytes * 2**20)
    for start in range(0, len(pages), mmap.PAGESIZE):
        pages[start] = 1
    return pages


def test_spread_of_a_single_measurement():
    assert spread([3.0]) == {"min": 3.0, "median": 3.0}


def test_synthetic_map_is_the_same_for_the_same_seed(map_file, tmp_path, capsys):
    other = tmp_path / "other.ply"
    assert benchmark.main(["synthetic", "--gaussians", "20000", "--seed", "1", "--out", str(other)]) == 0
    assert "--pose" in capsys.readouterr().out
    gaussian_map = load_map(map_file)
    assert (len(gaussian_map), gaussian_map.sh_degree) == (20000, 3)
    np.testing.assert_array_equal(gaussian_map.means, two_rooms(20000).means)
    assert not np.array_equal(gaussian_map.means, load_map(other).means)


@pytest.mark.parametrize("count", [1, 100_000])
def test_two_rooms_have_as_many_gaussians_as_asked(count):
    assert len(two_rooms(count)) == count


@pytest.mark.slow
def test_two_rooms_are_like_what_speed_was_promised_for():
    """A typical view sees about a fifth of the map, the other most of it, and no pixel looks through the walls."""
    gaussian_map = two_rooms(200_000)
    assert 0.55 < share_in_view(gaussian_map.means, VIEWS["everything"]) < 0.68
    assert 0.18 < share_in_view(gaussian_map.means, VIEWS["typical"]) < 0.27
    renderer = create_renderer(gaussian_map, "cpu")
    for pose in VIEWS.values():
        render = renderer.render(pinhole((640, 480)), pose)
        assert render.alpha.mean() > 0.94
        assert np.nanmax(render.depth) < 11


def test_frames_of_a_map(map_file, tmp_path):
    pose = VIEWS["typical"]
    numbers = [*pose[:3, 3], *quaternion_from_matrix(pose[:3, :3])]
    report = measured(tmp_path, "render", "--map", map_file, "--size", "160x120", "--frames", "3", "--pose", *numbers)
    assert (report["gaussians"], report["size"], report["frames"]) == (20000, [160, 120], 3)
    expected = create_renderer(load_map(map_file), "cpu").render(pinhole((160, 120)), pose)
    assert report["coverage"] == pytest.approx(expected.alpha.mean(), abs=2e-3)
    for times in (report["cpu_ms"], report["wall_ms"]):
        assert 0 < times["min"] <= times["median"]
    assert list(report["stages_cpu_ms"]) == ["cull", "read", "project", "scatter", "sort and blend"]
    assert report["load"]["cold"]["seconds"] > report["load"]["from_cache"]["seconds"] > 0
    # 59 numbers of 4 bytes.
    assert report["parameters_mb"] == pytest.approx(20000 * 59 * 4 / 2**20, abs=0.1)
    assert report["machine"]["cores"] >= 1
    assert [path.name for path in map_file.parent.iterdir()] == ["map.ply"]


def test_without_a_pose_the_whole_map_is_in_view(map_file, tmp_path):
    gaussian_map = load_map(map_file)
    assert share_in_view(gaussian_map.means, view_of_all(gaussian_map)) > 0.85
    assert measured(tmp_path, "render", "--map", map_file, "--size", "64x48", "--frames", "1")["coverage"] > 0.1


@pytest.mark.slow
def test_frames_of_a_scene(scene, tmp_path, capsys):
    report = measured(tmp_path, "render", "--scene", scene, "--size", "160x120", "--threads", "1")
    assert (report["map"], report["frames"], report["threads"]) == (scene.name, 2, 1)
    assert report["coverage"] > 0.9
    assert f"{scene.name}: {report['gaussians']} Gaussians" in capsys.readouterr().out


@pytest.mark.slow
def test_query_is_split_into_stages(scene, tmp_path, capsys):
    report = measured(tmp_path, "query", "--scene", scene, "--matcher", "sift", "--sigma", "0.3")
    assert (report["photos"], report["localized"], report["matcher"]) == (2, 2, "sift")
    stages = report["stages_cpu_ms"]
    assert {"prepare", "render", "track", "solve", "verify"} <= stages.keys()
    # Medians of the parts need not add up to that of the whole.
    assert sum(stages.values()) == pytest.approx(report["cpu_ms"]["median"], rel=0.3)
    assert "2 of 2 photos localized" in capsys.readouterr().out


@pytest.mark.slow
def test_tracking_is_measured_near_the_photos_and_along_a_path(scene, tmp_path, capsys):
    report = measured(tmp_path, "track", "--scene", scene, "--frames", "3")
    assert (report["near"]["photos"], report["path"]["photos"]) == (2, 2)
    assert report["near"]["localized"] == report["path"]["localized"] == 2
    for part in ("near", "path"):
        assert {"render", "track", "solve"} <= report[part]["stages_cpu_ms"].keys()
        assert "features" not in report[part]["stages_cpu_ms"]
    assert report["path"]["max_error_deg"] < 0.2
    assert "along a path: 2 of 2 photos localized" in capsys.readouterr().out


@pytest.mark.slow
def test_scaling_measures_every_value_and_draws_it(tmp_path):
    rows = measure_scaling([1000, 2000])
    values = {varied: {row["value"] for row in rows if row["varied"] == varied} for varied in ("gaussians", "pixels")}
    assert values["gaussians"] == {1000, 2000}
    assert {160 * 120, 640 * 480, 1280 * 960} <= values["pixels"]
    path = tmp_path / "scaling.png"
    draw_scaling(rows, path)
    assert cv2.imread(str(path)).std() > 10


@pytest.mark.slow
@pytest.mark.nightly
def test_index_measures_every_count_and_draws_it(tmp_path):
    rows = measure_index([20, 40])
    made_up = [row for row in rows if "query_ms" in row]
    assert [row["views"] for row in made_up] == [20, 40]
    assert made_up[1]["size_mb"] > made_up[0]["size_mb"]
    path = tmp_path / "index.png"
    draw_index(rows, path)
    assert cv2.imread(str(path)).std() > 10


def test_outcomes_of_twins_are_counted_by_what_differs():
    rows = [{"different": different, "outcome": "right"} for different in (0.0, 0.001, 0.012, 0.013)]
    rows.append({"different": 0.013, "outcome": "ambiguous"})
    _, *lines = twins_table(rows).splitlines()
    assert lines[0].split() == ["none", "1", "1", "0", "0", "0"]
    assert [int(line.split()[-5]) for line in lines] == [1, 1, 0, 0, 3, 0]
    assert lines[4].split()[-4:] == ["2", "1", "0", "0"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["render", "--map", "/nowhere/map.ply"], "/nowhere/map.ply"),
        (["render", "--scene", "/nowhere"], "/nowhere"),
        (["query", "--scene", "/nowhere"], "/nowhere"),
        (["track", "--scene", "/nowhere"], "/nowhere"),
        (["render", "--map", "MAP", "--pose", "0", "0", "0", "0", "0", "0", "0"], "quaternion"),
        (["render", "--scene", "MAP", "--pose", "0", "0", "0", "0", "0", "0", "1"], "--pose"),
        (["opensplat", "--map", "/nowhere/map.ply", "--checkout", "/nowhere"], "/nowhere/map.ply"),
        (["opensplat", "--map", "MAP", "--checkout", "/nowhere"], "/nowhere/rasterizer/gsplat-cpu/gsplat_cpu.cpp"),
        (["synthetic", "--gaussians", "1", "--out", "/nowhere/map.ply"], "/nowhere/map.ply"),
    ],
)
def test_what_cannot_be_measured_is_said_in_one_line(map_file, capsys, arguments, says):
    assert benchmark.main([str(map_file) if argument == "MAP" else argument for argument in arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert says in lines[0]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["track", "--scene", "/nowhere", "--frames", "0"], "--frames: '0' is not a whole number of at least 1"),
        (["render", "--map", "MAP", "--frames", "0"], "--frames: '0' is not a whole number of at least 1"),
        (
            ["opensplat", "--map", "MAP", "--checkout", "/nowhere", "--frames", "0"],
            "--frames: '0' is not a whole number of at least 1",
        ),
        (["synthetic", "--gaussians", "0", "--out", "MAP"], "--gaussians: '0' is not a whole number of at least 1"),
        (["scaling", "--max-gaussians", "0", "--out", "p.png"], "--max-gaussians: '0' is not a whole number"),
        (["index", "--max-views", "99", "--out", "p.png"], "--max-views: '99' is not a whole number of at least 100"),
        (["twins", "--photos", "0"], "--photos: '0' is not a whole number of at least 1"),
        (["planar", "--photos", "0"], "--photos: '0' is not a whole number of at least 1"),
        (["planar", "--views", "12,0"], "--views: '0' is not a whole number of at least 1"),
    ],
)
def test_options_that_make_no_sense_are_said_in_one_line(map_file, capsys, arguments, says):
    with pytest.raises(SystemExit) as left:
        benchmark.main([str(map_file) if argument == "MAP" else argument for argument in arguments])
    assert left.value.code == 2
    assert says in capsys.readouterr().err.splitlines()[-1]


def test_the_old_name_of_an_option_works_with_a_notice(capsys):
    options = benchmark.make_parser().parse_args(["scaling", "--most", "300000", "--out", "plot.png"])
    assert options.max_gaussians == 300_000
    notice = "--most is now --max-gaussians; the old name works until the next release"
    assert capsys.readouterr().err.splitlines() == [notice]


def test_opensplat_is_not_asked_for_what_it_cannot_draw(map_file):
    gaussian_map = replace(load_map(map_file), antialiased=True)
    with pytest.raises(ValueError, match="antialiased"):
        measure_against_opensplat(Path("/nowhere"), gaussian_map, pinhole((64, 48)), [VIEWS["typical"]], 0)


@pytest.mark.parametrize(
    "arguments", [["render"], ["opensplat", "--map", "m"], ["render", "--map", "m", "--size", "640"], ["fly"]]
)
def test_wrong_command_line_ends_with_its_usage(capsys, arguments):
    with pytest.raises(SystemExit) as ended:
        benchmark.main(arguments)
    assert ended.value.code == 2
    assert "usage:" in capsys.readouterr().err
