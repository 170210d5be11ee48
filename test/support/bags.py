"""Bags of messages, good and bad, and what replay writes about them."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from gsfeatloc_ros.common.geometry import quaternion_from_matrix
from gsfeatloc_ros.simulate import bag_messages
from gsfeatloc_ros.simulate.bag import CAMERA_INFO_TOPIC, IMAGE_TOPIC, PRIOR_TOPIC, TRUTH_TOPIC
from gsfeatloc_ros.simulate.bag_messages import CAMERA_FRAME, STORE, header, make, pose, pose_stamped

TOPICS = {"image": IMAGE_TOPIC, "camera_info": CAMERA_INFO_TOPIC, "prior": PRIOR_TOPIC}
TRUTH = TRUTH_TOPIC


def image(stamp: float, rgb: np.ndarray, encoding: str = "rgb8") -> Any:
    """Return an image that says that its pixels (H, W, 3) uint8 RGB are of this encoding."""
    return replace(bag_messages.image(stamp, rgb), encoding=encoding)


def camera_info(stamp: float, camera, focal: float | None = None) -> Any:
    """Return the calibration of a camera, with this focal length in its place where one is given."""
    message = bag_messages.camera_info(stamp, camera)
    return message if focal is None else replace(message, k=np.diag([focal, focal, 1.0]).ravel())


def _with_covariance(T_map_camera: np.ndarray, covariance: np.ndarray) -> Any:
    return make("geometry_msgs/msg/PoseWithCovariance", pose=pose(T_map_camera), covariance=covariance.ravel())


def pose_with_covariance(stamp: float, T_map_camera: np.ndarray, covariance: np.ndarray) -> Any:
    """Return a PoseWithCovarianceStamped in the frame of the map."""
    content = _with_covariance(T_map_camera, covariance)
    return make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header(stamp, "map"), pose=content)


def odometry(stamp: float, T_frame_body: np.ndarray, frame: str = "map", body: str = "camera") -> Any:
    """Return an Odometry of a body in a frame; of the camera in that of the map."""
    zero = make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    twist = make(
        "geometry_msgs/msg/TwistWithCovariance",
        twist=make("geometry_msgs/msg/Twist", linear=zero, angular=zero),
        covariance=np.zeros(36),
    )
    content = _with_covariance(T_frame_body, np.zeros((6, 6)))
    return make("nav_msgs/msg/Odometry", header=header(stamp, frame), child_frame_id=body, pose=content, twist=twist)


def transform(stamp: float, parent: str, child: str, T_parent_child: np.ndarray) -> Any:
    """Return a TransformStamped of the pose (4, 4) of a frame in its parent."""
    rotation = make("geometry_msgs/msg/Quaternion", *quaternion_from_matrix(T_parent_child[:3, :3]).tolist())
    moved = make(
        "geometry_msgs/msg/Transform",
        translation=make("geometry_msgs/msg/Vector3", *T_parent_child[:3, 3].tolist()),
        rotation=rotation,
    )
    return make(
        "geometry_msgs/msg/TransformStamped", header=header(stamp, parent), child_frame_id=child, transform=moved
    )


def transforms(*stamped: Any) -> Any:
    """Return the message of /tf, or of /tf_static, with these transforms."""
    return make("tf2_msgs/msg/TFMessage", transforms=list(stamped))


def compressed_image(stamp: float, rgb: np.ndarray, suffix: str, form: str) -> Any:
    """Return an image compressed to a suffix such as .png, with the field `format`."""
    data = cv2.imencode(suffix, rgb[:, :, ::-1])[1].ravel()
    return make("sensor_msgs/msg/CompressedImage", header=header(stamp, CAMERA_FRAME), format=form, data=data)


def write_messages(
    path: Path,
    messages: list,
    storage: StoragePlugin = StoragePlugin.MCAP,
    topics: dict | None = None,
    step: float = 0.001,
) -> Path:
    """A bag of (topic, message) or (topic, (type, bytes)), recorded so many seconds apart from one second on."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for topic, name in (topics or {}).items():
            connections[topic] = writer.add_connection(topic, name, typestore=STORE)
        for number, (topic, message) in enumerate(messages, start=1):
            name, cdr = message if isinstance(message, tuple) else (message.__msgtype__, None)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=STORE)
            cdr = STORE.serialize_cdr(message, name) if cdr is None else cdr
            writer.write(connections[topic], 10**9 + round(1e9 * step * number), cdr)
    return path


def recording(photo, camera, *, stamp: float | None = None) -> list:
    """The messages of a photo, in the order of write_bag."""
    stamp = photo.stamp if stamp is None else stamp
    return [
        (TOPICS["prior"], pose_stamped(stamp - 0.01, photo.T_map_camera_prior)),
        (TOPICS["camera_info"], camera_info(stamp, camera)),
        (TOPICS["image"], image(stamp, photo.image)),
        (TRUTH, pose_stamped(stamp, photo.T_map_camera)),
    ]


def replay_arguments(bag: Path, map_file: Path, out: Path, *more: str, truth: bool = True) -> list[str]:
    """Return the command line of replay for a bag of these topics; an index of the map is not made for it."""
    options = [str(bag), "--map", str(map_file), "--out", str(out), "-p", "index.build:=false"]
    for role, topic in TOPICS.items():
        options += [f"--{role.replace('_', '-')}", topic]
    return [*options, *(["--truth", TRUTH] if truth else []), *more]


def rows_of(out: Path) -> list[dict[str, str]]:
    """Return the lines of answers.csv by column."""
    with (out / "answers.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def rotated(quaternion: np.ndarray) -> np.ndarray:
    """Where a quaternion xyzw takes the three axes, as columns: v + 2 u x (u x v + w v)."""
    u, w = np.array(quaternion[:3]), quaternion[3]
    return np.column_stack([v + 2 * np.cross(u, np.cross(u, v) + w * v) for v in np.eye(3)])
