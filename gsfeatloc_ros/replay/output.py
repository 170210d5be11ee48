"""What came of a bag's images in files: TUM, CSV and a bag of poses."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from gsfeatloc_ros.common.geometry import quaternion_from_matrix, rotation_error_deg, translation_error
from gsfeatloc_ros.localize.evidence import Evidence
from gsfeatloc_ros.replay.run import ReplayedImage, StampedPose
from gsfeatloc_ros.replay.truth import Trajectory

POSE_TOPIC = "/pose"

_ABOUT = ("stamp", "bag_time", "status", "reason", "state", "prior")
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_VARIANCES = ("var_x", "var_y", "var_z", "var_rx", "var_ry", "var_rz")
_ERRORS = (
    "rotation_error_deg",
    "translation_error",
    "prior_rotation_error_deg",
    "prior_translation_error",
)


def errors(image: ReplayedImage, truth: Trajectory) -> dict[str, float]:
    """Return the errors of an image's pose and of its prior, in degrees and map units; without those not known."""
    true_pose = None if image.stamp is None else truth.at(image.stamp)
    if true_pose is None:
        return {}
    prior = None if image.query is None else image.query.T_map_camera_prior
    poses = {"": image.T_map_camera, "prior_": prior}
    values = {}
    for prefix, pose in poses.items():
        if pose is not None:
            values[f"{prefix}rotation_error_deg"] = rotation_error_deg(true_pose, pose)
            values[f"{prefix}translation_error"] = translation_error(true_pose, pose)
    return values


def write_tum(path: Path, images: Sequence[ReplayedImage]) -> None:
    """Write a line ``stamp x y z qx qy qz qw`` for each image that has a pose."""
    with path.open("w", encoding="utf-8") as file:
        for pose in (image.pose for image in images):
            if pose is not None:
                numbers = " ".join(f"{value:.9f}" for value in _pose_values(pose.T_map_body))
                print(_seconds(pose.stamp), numbers, file=file)


def write_csv(path: Path, images: Sequence[ReplayedImage], truth: Trajectory | None) -> None:
    """Write a line for each image; what is not known is empty. With `truth`, the errors too."""
    names = [
        "stamp",
        "bag_time",
        "status",
        "reason",
        "state",
        "prior",
        *Evidence().numbers(),
        "ms",
        *_POSE,
        *_VARIANCES,
    ]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, names + (list(_ERRORS) if truth else []), lineterminator="\n")
        writer.writeheader()
        for image in images:
            writer.writerow(_row(image) | (errors(image, truth) if truth else {}))


def write_bag(path: Path, storage: StoragePlugin, images: Sequence[ReplayedImage], map_frame: str) -> None:
    """Write a new rosbag2: a PoseWithCovarianceStamped on POSE_TOPIC for each image that has a pose.

    Its header has the stamp of the image, and it is recorded at the same time as the image, so that both bags can be
    played together.
    """
    types = get_typestore(Stores.ROS2_JAZZY)
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connection = writer.add_connection(POSE_TOPIC, kind, typestore=types)
        for image in images:
            if image.pose is not None:
                message = _pose_message(types.types, image.pose, map_frame)
                writer.write(connection, image.bag_time, types.serialize_cdr(message, kind))


def _row(image: ReplayedImage) -> dict[str, object]:
    outcome, pose = image.outcome, image.pose
    row: dict[str, object] = {
        "stamp": "" if image.stamp is None else _seconds(image.stamp),
        "bag_time": _seconds(image.bag_time),
        "status": outcome.status.value,
        "reason": outcome.reason,
        "state": image.state.value,
    }
    if image.query is not None and image.query.source is not None:
        row["prior"] = image.query.source.value
    if outcome.estimate is not None:
        numbers = outcome.estimate.evidence.numbers()
        row |= {name: "" if math.isnan(number) else number for name, number in numbers.items()}
        row["ms"] = f"{outcome.estimate.milliseconds['total']:.1f}"
    if pose is not None:
        row |= zip(_POSE, _pose_values(pose.T_map_body), strict=True)
        row |= zip(_VARIANCES, pose.covariance.diagonal().tolist(), strict=True)
    return row


def _pose_values(pose: np.ndarray) -> list[float]:
    """Return x y z qx qy qz qw of a pose (4, 4)."""
    return [*pose[:3, 3].tolist(), *quaternion_from_matrix(pose[:3, :3]).tolist()]


def _pose_message(types: Mapping[str, type], pose: StampedPose, map_frame: str) -> object:
    seconds, rest = divmod(pose.stamp, 1_000_000_000)
    values = _pose_values(pose.T_map_body)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    position = types["geometry_msgs/msg/Point"](*values[:3])
    orientation = types["geometry_msgs/msg/Quaternion"](*values[3:])
    return types["geometry_msgs/msg/PoseWithCovarianceStamped"](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=map_frame),
        pose=types["geometry_msgs/msg/PoseWithCovariance"](
            pose=types["geometry_msgs/msg/Pose"](position=position, orientation=orientation),
            covariance=pose.covariance.ravel(),
        ),
    )


def _seconds(nanoseconds: int) -> str:
    """Return nanoseconds as seconds with nine decimals, exact."""
    sign = "-" if nanoseconds < 0 else ""
    seconds, rest = divmod(abs(nanoseconds), 1_000_000_000)
    return f"{sign}{seconds}.{rest:09d}"
