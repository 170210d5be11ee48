"""The answers to a bag in files: TUM, CSV and a bag of their own."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from gsfeatloc_ros.common.geometry import quaternion_from_matrix, rotation_error_deg, translation_error
from gsfeatloc_ros.replay.run import Answer
from gsfeatloc_ros.replay.truth import Trajectory

POSE_TOPIC = "/pose"

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_VARIANCES = ("var_x", "var_y", "var_z", "var_rx", "var_ry", "var_rz")
_EVIDENCE = ("inliers", "inlier_ratio", "coverage", "agreement", "passes", "views")
_ERRORS = (
    "rotation_error_deg",
    "translation_error",
    "prior_rotation_error_deg",
    "prior_translation_error",
)


def errors(answer: Answer, truth: Trajectory) -> dict[str, float]:
    """How far the answer and its prior are off, in degrees and map units; what is not known is left out."""
    true_pose = None if answer.stamp is None else truth.at(answer.stamp)
    if true_pose is None:
        return {}
    poses = {"": answer.estimate and answer.estimate.T_map_camera, "prior_": answer.T_map_camera_prior}
    values = {}
    for prefix, pose in poses.items():
        if pose is not None:
            values[f"{prefix}rotation_error_deg"] = rotation_error_deg(true_pose, pose)
            values[f"{prefix}translation_error"] = translation_error(true_pose, pose)
    return values


def write_tum(path: Path, answers: Sequence[Answer]) -> None:
    """A line ``stamp x y z qx qy qz qw`` for each answer that has a pose."""
    with path.open("w", encoding="utf-8") as file:
        for answer in answers:
            if answer.localized:
                numbers = " ".join(f"{value:.9f}" for value in _pose_values(answer.estimate.T_map_camera))
                print(_seconds(answer.stamp), numbers, file=file)


def write_csv(path: Path, answers: Sequence[Answer], truth: Trajectory | None) -> None:
    """A line for each image; what is not known is empty. With `truth`, the errors too."""
    names = ["stamp", "bag_time", "status", "reason", *_EVIDENCE, "ms", *_POSE, *_VARIANCES]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, names + (list(_ERRORS) if truth else []), lineterminator="\n")
        writer.writeheader()
        for answer in answers:
            writer.writerow(_row(answer) | (errors(answer, truth) if truth else {}))


def write_bag(path: Path, storage: StoragePlugin, answers: Sequence[Answer], map_frame: str) -> None:
    """Write a new rosbag2: a PoseWithCovarianceStamped on POSE_TOPIC for each answer that has a pose.

    Its header has the stamp of the image, and it is recorded at the same time as the image, so that both bags can be
    played together.
    """
    types = get_typestore(Stores.ROS2_JAZZY)
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connection = writer.add_connection(POSE_TOPIC, kind, typestore=types)
        for answer in answers:
            if answer.localized:
                message = _pose_message(types.types, answer, map_frame)
                writer.write(connection, answer.bag_time, types.serialize_cdr(message, kind))


def _row(answer: Answer) -> dict[str, object]:
    row: dict[str, object] = {
        "stamp": "" if answer.stamp is None else _seconds(answer.stamp),
        "bag_time": _seconds(answer.bag_time),
        "status": answer.status,
        "reason": answer.reason,
    }
    estimate = answer.estimate
    if estimate:
        numbers = {name: getattr(estimate, name) for name in _EVIDENCE}
        row |= {name: "" if math.isnan(value) else value for name, value in numbers.items()}
        row["ms"] = f"{estimate.milliseconds['total']:.1f}"
    if answer.localized:
        row |= zip(_POSE, _pose_values(estimate.T_map_camera), strict=True)
        row |= zip(_VARIANCES, estimate.covariance.diagonal().tolist(), strict=True)
    return row


def _pose_values(pose: np.ndarray) -> list[float]:
    """x y z qx qy qz qw of a pose (4, 4)."""
    return [*pose[:3, 3].tolist(), *quaternion_from_matrix(pose[:3, :3]).tolist()]


def _pose_message(types: dict[str, type], answer: Answer, map_frame: str) -> object:
    seconds, rest = divmod(answer.stamp, 1_000_000_000)
    values = _pose_values(answer.estimate.T_map_camera)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](*values[:3]),
        orientation=types["geometry_msgs/msg/Quaternion"](*values[3:]),
    )
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    return types["geometry_msgs/msg/PoseWithCovarianceStamped"](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=map_frame),
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=answer.estimate.covariance.ravel()),
    )


def _seconds(nanoseconds: int) -> str:
    """Exact, with nine decimals."""
    sign = "-" if nanoseconds < 0 else ""
    seconds, rest = divmod(abs(nanoseconds), 1_000_000_000)
    return f"{sign}{seconds}.{rest:09d}"
