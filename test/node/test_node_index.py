"""The installed localizer and the view index that it builds; alone, for it is asked what it cannot answer yet."""

from __future__ import annotations

import signal
import time

import numpy as np
from node_harness import TIMEOUT, connected_client, running_localizer

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image
from gsfeatloc_ros.index.storage import load_index

# Seconds in which the node leaves while it builds its index, on a slow machine.
LEAVING = 5.0


def test_the_index_does_not_hold_up_the_node(room_map_file, room_camera, photo, tmp_path):
    """It is ready before its index is, answers meanwhile by priors, and leaves at once."""
    parameters = {"map__path": room_map_file, "index__path": tmp_path / "room.index", "index__views": 5000}
    parameters["index__build"] = True
    with running_localizer(**parameters) as process, connected_client() as client:
        process.wait_for_output(r"building the view index: looked from \d+ of \d+ places", TIMEOUT)
        client.send_camera_info(camera_info_of(room_camera))
        without = client.attempt(rgb_image(photo.image))
        assert without.values["status"] == "failed"
        assert "index" in without.reason
        client.send_prior(pose_stamped(photo.T_map_camera_prior))
        assert client.attempt(rgb_image(photo.image)).ok
        assert client.spin_until(lambda: any("building" in said.reason for said in client.index))
        began = time.monotonic()
        process.signal(signal.SIGTERM)
        assert process.wait() == 0
        assert time.monotonic() - began < LEAVING
        assert "Traceback" not in process.output
        assert "did not end in time" not in process.output
    assert list(tmp_path.iterdir()) == []


def test_the_index_of_a_robot_on_the_floor_looks_from_its_camera(room_map_file, tmp_path):
    path, place = tmp_path / "room.index", {"index__camera_height": 0.5, "index__camera_pitch": 5.0}
    parameters = {"map__path": room_map_file, "index__path": path, "index__views": 4, "index__build": True} | place
    with running_localizer(map__aligned=True, **parameters) as process:
        process.wait_for_index()
    made = load_index(path)
    assert made is not None
    np.testing.assert_allclose(made.poses[:, 2, 3], 0.5)
    np.testing.assert_allclose(made.poses[:, 2, 2], np.sin(np.radians(5.0)), atol=1e-9)
