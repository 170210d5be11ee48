"""Replay gives the answers that the node gives to the same bag."""

from __future__ import annotations

import numpy as np
import pytest
from bags import TOPICS, pose_stamped, recording, replay_arguments, rotated, rows_of, write_messages

from gsfeatloc_ros.client.bag_player import Topics, play_bag
from gsfeatloc_ros.client.process import running_localizer
from gsfeatloc_ros.tools.replay import main


def test_answers_are_those_of_the_node(room_camera, room_photos, room_map_file, tmp_path):
    """Also where an image comes before its camera_info, and where an unusable prior took the place of a good one."""
    first, second, third, fourth = room_photos[:4]
    elsewhere = pose_stamped(fourth.stamp - 0.02, fourth.T_map_camera_prior, "odom")
    messages = [
        *recording(first, room_camera)[:1],
        *recording(first, room_camera)[2:],
        *recording(second, room_camera),
        *recording(third, room_camera)[2:],  # with the prior of the second
        (TOPICS["prior"], elsewhere),
        *recording(fourth, room_camera)[1:],
        *recording(fourth, room_camera, stamp=fourth.stamp + 0.5),
    ]
    bag = write_messages(tmp_path / "bag", messages)
    assert main(replay_arguments(bag, room_map_file, tmp_path / "out")) == 0
    with running_localizer({"map.path": room_map_file, "matcher.name": "sift"}, TOPICS) as localizer:
        live = list(play_bag(bag, Topics(**TOPICS), is_running=lambda: localizer.alive))
    rows = rows_of(tmp_path / "out")
    assert [row["status"] for row in rows][:2] == ["refused", "localized"]
    assert [row["status"] for row in rows][3:] == ["refused", "localized"]
    for row, reply in zip(rows, live, strict=True):
        assert (row["stamp"], row["status"]) == (reply.stamp, reply.evidence["status"])
        if row["status"] != "refused":
            assert row["reason"] == reply.evidence["reason"]
        assert bool(row["x"]) == (reply.T_map_camera is not None)
        if row["x"]:
            pose = np.array([float(row[name]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")])
            assert pose[:3] == pytest.approx(reply.T_map_camera[:3, 3], abs=1e-12)
            assert rotated(pose[3:]) == pytest.approx(reply.T_map_camera[:3, :3], abs=1e-12)
