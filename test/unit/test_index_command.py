"""python -m gsfeatloc_ros.tools.index: the index made ahead of use."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from room_datasets import OPENGL, write_nerfstudio

from gsfeatloc_ros.common.geometry import matrix_from_quaternion
from gsfeatloc_ros.index import IndexOptions
from gsfeatloc_ros.index.storage import index_path, load_index
from gsfeatloc_ros.localize.map_index import index_key
from gsfeatloc_ros.localize.settings import MapSettings, MatcherSettings
from gsfeatloc_ros.maps import Similarity
from gsfeatloc_ros.simulate.photos import Walk
from gsfeatloc_ros.tools import index

FEW = ["--views", "3"]


@pytest.fixture
def map_path(tmp_path, room_map_file) -> Path:
    """A map in a folder of its own."""
    path = tmp_path / "room.ply"
    path.symlink_to(room_map_file)
    return path


def key_of(path: Path, **settings):
    return index_key(str(path), MapSettings(**settings), MatcherSettings(), IndexOptions())


def test_the_index_lies_where_the_node_looks_for_it_and_is_what_it_expects(map_path, capsys) -> None:
    assert index.main([str(map_path), *FEW]) == 0
    made = load_index(index_path(map_path), key_of(map_path))
    assert made is not None
    assert len(made) == 3
    *_, line = capsys.readouterr().out.splitlines()
    says = re.fullmatch(r"(.+): 3 views, (\d+) features, (\d+\.\d) MB, \d+\.\d s", line)
    assert says is not None
    assert says[1] == str(index_path(map_path))
    assert int(says[2]) == len(made.codes)
    assert float(says[3]) == pytest.approx(index_path(map_path).stat().st_size / 1e6, abs=0.05)


def test_another_seed_gives_another_index_where_it_was_asked_for(map_path, tmp_path) -> None:
    files = [tmp_path / f"{seed}.index" for seed in "01"]
    for seed, file in zip("01", files, strict=True):
        assert index.main([str(map_path), *FEW, "--seed", seed, "--threads", "1", "--out", str(file)]) == 0
    one, other = (load_index(file, key_of(map_path)) for file in files)
    assert one is not None
    assert other is not None
    assert not np.array_equal(one.poses, other.poses)
    assert not index_path(map_path).exists()


def test_views_are_placed_where_the_camera_of_a_robot_on_the_floor_is(map_path) -> None:
    plane = ["--camera-height", "0.4", "--camera-pitch", "-10"]
    assert index.main([str(map_path), *FEW, *plane]) == 0
    key = partial(index_key, str(map_path), MapSettings(), MatcherSettings())
    made = load_index(index_path(map_path), key(IndexOptions(camera_height=0.4, camera_pitch=-10.0)))
    assert made is not None
    np.testing.assert_allclose(made.poses[:, 2, 3], 0.4)
    np.testing.assert_allclose(made.poses[:, 2, 2], np.sin(np.radians(-10)), atol=1e-9)
    # Who does not say where views have to be takes these; who does takes no others.
    assert load_index(index_path(map_path), key(IndexOptions())) is not None
    assert load_index(index_path(map_path), key(IndexOptions(camera_height=0.5, camera_pitch=-10.0))) is None


@pytest.mark.parametrize("kind", ["scene", "transforms.json"])
def test_training_poses_are_used_in_the_robots_frame(kind, map_path, tmp_path, room_camera, room_photos) -> None:
    frames = [Walk(np.zeros(4)).pose(time) for time in range(0, 30, 5)]
    if kind == "scene":
        poses = write_nerfstudio(tmp_path, room_camera, room_photos[:2], map_path)
        frames = [photo.T_map_camera for photo in room_photos[:2]] + [
            Walk(np.zeros(4)).pose(time) for time in range(0, 30, 3)
        ]
    else:
        poses = tmp_path / "transforms.json"
        transforms = [{"file_path": "x.png", "transform_matrix": (pose @ OPENGL).tolist()} for pose in frames]
        poses.write_text(json.dumps({"frames": transforms}))
    out, rotation = tmp_path / "map.index", (0.0, 0.0, 0.6, 0.8)
    frame = ["--map-scale", "2", "--map-translation", "1", "2", "3", "--map-rotation", *map(str, rotation)]
    assert index.main([str(map_path), *FEW, "--poses", str(poses), *frame, "--out", str(out)]) == 0
    made = load_index(out, key_of(map_path, scale=2.0, translation=(1.0, 2.0, 3.0), rotation=rotation))
    assert made is not None
    placed = Similarity(2.0, matrix_from_quaternion(np.array(rotation)), np.array([1.0, 2.0, 3.0]))
    expected = np.array([placed.transform_pose(pose) for pose in frames])
    for pose in made.poses:
        assert np.isclose(pose, expected).all(axis=(1, 2)).any()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere.ply"], "nowhere.ply"),
        (["room.ply", "--poses", "nowhere"], "holds none of transforms.json"),
        (["room.ply", "--poses", "room.ply"], "room.ply"),
        (["room.ply", "--poses", "empty.json"], "frames is empty"),
        (["room.ply", "--camera-height", "900"], "nothing of the map is seen from 900 above its plane z = 0"),
        (["room.ply", "--out", "."], "cannot be written"),
        (["room.ply", "--out", "/proc/nowhere/room.index"], "cannot be written"),
        (["room.ply", "--map-scale", "-1"], "scale -1"),
        (["room.ply", "--matcher", "xfeat", "--weights", "/nowhere/xfeat.pt"], "/nowhere/xfeat.pt"),
        (["empty.json"], "empty.json"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_line(map_path, monkeypatch, capsys, arguments, says) -> None:
    monkeypatch.chdir(map_path.parent)
    Path("empty.json").write_text('{"frames": []}')
    assert index.main(arguments) == 2
    error = capsys.readouterr().err
    # Before it there may be one on how the map is read.
    *notes, reason = error.splitlines()
    assert reason.startswith("index: ")
    assert says in reason
    assert all("(map.antialiased)" in note for note in notes)
    assert not Path("room.ply.gsfeatloc-index").exists()


def test_a_map_that_is_not_there_makes_no_folder(tmp_path) -> None:
    assert index.main([str(tmp_path / "a" / "map.ply")]) == 2
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    "arguments",
    [[], ["a.ply", "b.ply"], ["a.ply", "--views", "0"], ["a.ply", "--matcher", "orb"], ["a.ply", "--seed", "-1"]],
)
def test_wrong_command_line_ends_with_its_usage(capsys, arguments) -> None:
    with pytest.raises(SystemExit) as exit_:
        index.main(arguments)
    assert exit_.value.code == 2
    assert "usage: gsfeatloc index" in capsys.readouterr().err


def test_the_user_may_interrupt_it(map_path, monkeypatch, capsys) -> None:
    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(index, "build_index", interrupt)
    assert index.main([str(map_path)]) == 130
    assert "interrupted" in capsys.readouterr().err
