"""Replay gives the answers that the node gives to the same bag."""

from __future__ import annotations

import numpy as np
import pytest
from bags import (
    TOPICS,
    odometry,
    pose_stamped,
    recording,
    replay_arguments,
    rotated,
    rows_of,
    transform,
    transforms,
    write_messages,
)
from nav_msgs.msg import Odometry
from tf2_msgs.msg import TFMessage

from gsfeatloc_ros.client.bag_player import Topics, play_bag
from gsfeatloc_ros.client.process import running_localizer
from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp
from gsfeatloc_ros.node.qos import LATCHED, RELIABLE, Topic
from gsfeatloc_ros.simulate.bag_messages import CAMERA_FRAME
from gsfeatloc_ros.tools.replay import main

ODOM, TF, TF_STATIC = "/odom", "/tf", "/tf_static"
OTHERS = (Topic(Odometry, ODOM, RELIABLE), Topic(TFMessage, TF, RELIABLE), Topic(TFMessage, TF_STATIC, LATCHED))
PARAMETERS = {"track": True, "prior_frame": "base", "pose_frame": "base", "index.build": False, "matcher.name": "sift"}
T_BASE_CAMERA = make_pose(so3_exp(np.array([-1.5, 0.0, -1.4])), [0.1, 0.05, 0.6])
T_MAP_ODOM = make_pose(so3_exp(np.array([0.0, 0.0, 0.7])), [2.0, -1.0, 0.0])


def robot(photo, camera) -> list:
    """A photo as the robot records it: where odom is in the map, where the base is in odom, camera_info and image."""
    T_odom_base = invert(T_MAP_ODOM) @ photo.T_map_camera @ invert(T_BASE_CAMERA)
    _, camera_info, image, truth = recording(photo, camera)
    return [
        (TF, transforms(transform(photo.stamp, "map", "odom", T_MAP_ODOM))),
        (ODOM, odometry(photo.stamp, T_odom_base, "odom", "base_link")),
        camera_info,
        image,
        truth,
    ]


def prior_of(photo, frame: str = "odom") -> tuple:
    """The prior of a photo, of the base in the odometry's frame."""
    T_odom_base = invert(T_MAP_ODOM) @ photo.T_map_camera_prior @ invert(T_BASE_CAMERA)
    return TOPICS["prior"], pose_stamped(photo.stamp, T_odom_base, frame)


def test_answers_are_those_of_the_node(room_camera, room_photos, room_map_file, tmp_path, tf):
    """With tf, odometry and one prior; where an image comes before its camera_info, and where a prior is unusable."""
    first, second, third, fourth = room_photos[:4]
    _, _, image, truth = recording(first, room_camera)
    messages = [
        (TF_STATIC, transforms(transform(1.0, "base_link", CAMERA_FRAME, T_BASE_CAMERA))),
        *(image, truth),
        prior_of(second),
        *robot(second, room_camera),
        *robot(third, room_camera),  # by odometry from the answer before
        prior_of(fourth, "elsewhere"),
        *robot(fourth, room_camera),
    ]
    bag = write_messages(tmp_path / "bag", messages)
    options = [text for name, value in PARAMETERS.items() for text in ("-p", f"{name}:={str(value).lower()}")]
    assert main(replay_arguments(bag, room_map_file, tmp_path / "out", "--odom", ODOM, *options)) == 0
    with running_localizer({"map.path": room_map_file, **PARAMETERS}, TOPICS | {"odom": ODOM}) as localizer:
        topics = Topics(**TOPICS, others=OTHERS)
        live = list(play_bag(bag, topics, is_running=lambda: localizer.alive))
    rows = rows_of(tmp_path / "out")
    assert [row["status"] for row in rows] == ["refused", "localized", "localized", "refused"], rows
    assert [row["prior"] for row in rows] == ["", "prior", "last answer", ""]
    for row, reply in zip(rows, live, strict=True):
        assert (row["stamp"], row["status"]) == (reply.stamp, reply.evidence["status"])
        assert row["state"] == reply.evidence["state"]
        if row["status"] != "refused":
            assert row["reason"] == reply.evidence["reason"]
            assert row["prior"] == reply.evidence["prior"]
        assert bool(row["x"]) == (reply.T_map_camera is not None)
        if row["x"]:
            # Of the base. What the node looked up in tf has been through quaternions.
            pose = np.array([float(row[name]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")])
            assert pose[:3] == pytest.approx(reply.T_map_camera[:3, 3], abs=1e-7)
            assert rotated(pose[3:]) == pytest.approx(reply.T_map_camera[:3, :3], abs=1e-7)
    assert "is in frame 'elsewhere' but the map is in 'map'" in rows[-1]["reason"]
