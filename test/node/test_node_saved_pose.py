"""The installed localizer is started again: it looks first where it was."""

from __future__ import annotations

import json

import numpy as np
import pytest
from node_harness import TIMEOUT, assert_answer, assert_close, connected_client, running_localizer, send_inputs

from gsfeatloc_ros.client.messages import camera_info_of, rgb_image
from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion


@pytest.fixture
def saved(room_map_file, room_camera, photo, tmp_path):
    """The file of the pose that a run has left."""
    path = tmp_path / "pose.json"
    parameters = {"map__path": room_map_file, "track": True, "state__path": path}
    with running_localizer(**parameters), connected_client() as client:
        send_inputs(client, room_camera, photo)
        assert_answer(client, photo)
    return path


def test_the_last_pose_is_kept_and_looked_at_first(saved, room_map_file, room_camera, photo):
    content = json.loads(saved.read_text())
    pose = make_pose(matrix_from_quaternion(content["orientation"]), content["position"])
    np.testing.assert_allclose(pose, photo.T_map_camera, atol=0.02)
    parameters = {"map__path": room_map_file, "track": True, "state__path": saved}
    with running_localizer(**parameters) as process, connected_client() as client:
        client.send_camera_info(camera_info_of(room_camera))
        image = rgb_image(photo.image)
        answer = client.attempt(image)
        assert answer.ok, f"{answer.reason}\n{process.output}"
        assert answer.values["prior"] == "saved pose"
        assert_close(client.pose_of(image), photo.T_map_camera)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:50]), "is damaged"),
        (lambda path: path.write_text(path.read_text().replace("room.ply", "hall.ply")), "is of another map"),
    ],
    ids=["damaged", "of another map"],
)
def test_a_file_that_cannot_be_used_is_named_once_and_ignored(saved, room_map_file, room_camera, photo, spoil, says):
    spoil(saved)
    parameters = {"map__path": room_map_file, "track": True, "state__path": saved}
    with running_localizer(**parameters) as process, connected_client() as client:
        process.wait_for_output(rf"\[WARN\].*state\.path: the saved pose is not used: .*pose\.json {says}", TIMEOUT)
        assert process.output.count("the saved pose is not used") == 1
        send_inputs(client, room_camera, photo)
        assert_answer(client, photo)
    # It is written anew.
    assert "hall.ply" not in saved.read_text()
    json.loads(saved.read_text())


def test_where_it_cannot_be_saved_the_node_says_so_and_goes_on(room_map_file, room_camera, photo, tmp_path):
    parameters = {"map__path": room_map_file, "track": True, "state__path": tmp_path / "nowhere" / "pose.json"}
    with running_localizer(**parameters) as process, connected_client() as client:
        send_inputs(client, room_camera, photo)
        assert_answer(client, photo)
        process.wait_for_output(r"state\.path: the pose cannot be saved: .*No such file", TIMEOUT)
        assert_answer(client, photo)
