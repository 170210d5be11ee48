"""The last good pose in a file."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.ros_io.saved_pose import load_pose, save_pose

MAP = {"path": "/maps/room.ply", "frame_id": "map", "scale": 1.0, "translation": (0.0, 0.0, 1.0)}
POSE = make_pose(so3_exp(np.array([0.1, -0.4, 2.0])), [1.0, -2.0, 0.3])
components = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


@given(rotation=components, translation=components)
def test_what_is_saved_is_loaded(tmp_path_factory, rotation, translation):
    path = tmp_path_factory.mktemp("state") / "pose.json"
    pose = make_pose(so3_exp(rotation), translation)
    save_pose(path, pose, MAP)
    np.testing.assert_allclose(load_pose(path, MAP), pose, atol=1e-12)
    assert [file.name for file in path.parent.iterdir()] == ["pose.json"]


def test_nothing_was_saved(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_pose(tmp_path / "pose.json", MAP)


@pytest.mark.parametrize(
    "change", [{"path": "/maps/hall.ply"}, {"frame_id": "world"}, {"scale": 2.0}, {"translation": (0.0, 0.0, 0.0)}]
)
def test_of_another_map(tmp_path, change):
    save_pose(tmp_path / "pose.json", POSE, MAP)
    with pytest.raises(ValueError, match="is of another map, or of this one placed otherwise"):
        load_pose(tmp_path / "pose.json", MAP | change)


@given(data=st.data())
def test_a_damaged_file_is_refused_in_one_line(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("state") / "pose.json"
    save_pose(path, POSE, MAP)
    whole = path.read_bytes()
    place = data.draw(st.integers(0, len(whole) - 1))
    path.write_bytes(data.draw(st.sampled_from([whole[:place], whole[:place] + b"\xff" + whole[place + 1 :]])))
    with pytest.raises(ValueError, match=r"pose\.json is") as error:
        load_pose(path, MAP)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"[]", b"7", b"null", b"[" * 60000, b"x" * 10**6),
        *({"position": value} for value in ([1, 2], [1, 2, float("nan")], "here", [[1, 2, 3]])),
        {"orientation": [0, 0, 0, 0]},
        {"version": 2},
    ],
    ids=str,
)
def test_what_is_no_pose_is_refused(tmp_path, content):
    path = tmp_path / "pose.json"
    save_pose(path, POSE, MAP)
    if isinstance(content, dict):
        content = json.dumps(json.loads(path.read_text()) | content).encode()
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"pose\.json is damaged"):
        load_pose(path, MAP)


def test_where_it_cannot_be_written_the_old_one_stays(tmp_path, monkeypatch):
    path = tmp_path / "pose.json"
    save_pose(path, POSE, MAP)
    monkeypatch.setattr("os.fsync", lambda file: (_ for _ in ()).throw(OSError("no space left")))
    with pytest.raises(OSError, match="no space left"):
        save_pose(path, np.eye(4), MAP)
    np.testing.assert_allclose(load_pose(path, MAP), POSE, atol=1e-12)
    assert [file.name for file in tmp_path.iterdir()] == ["pose.json"]
