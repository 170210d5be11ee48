"""ROS messages of cameras, images and poses for the localizer, and what it publishes as numpy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion
from gsfeatloc_ros.node.diagnostics import stamp_text
from gsfeatloc_ros.node.encode import image_message, pose_message

CAMERA_FRAME = "camera_optical"


def rgb_image(rgb: np.ndarray) -> Image:
    """Return an image message of pixels (H, W, 3) uint8 RGB, without a stamp."""
    return image_message(rgb, Header(frame_id=CAMERA_FRAME))


def camera_info_of(camera: Camera) -> CameraInfo:
    """Return the calibration of a camera, without a stamp."""
    return CameraInfo(
        width=camera.width,
        height=camera.height,
        k=camera.K.ravel().tolist(),
        d=camera.distortion.tolist(),
        distortion_model=camera.model,
    )


def pose_with_covariance(
    pose: np.ndarray, covariance: np.ndarray | None = None, frame_id: str = "map"
) -> PoseWithCovarianceStamped:
    """Return a pose (4, 4) with its covariance (6, 6) in ROS order, zeros by default, without a stamp."""
    covariance = np.zeros((6, 6)) if covariance is None else np.asarray(covariance)
    return pose_message(pose, covariance, Header(frame_id=frame_id))


def pose_stamped(pose: np.ndarray, frame_id: str = "map") -> PoseStamped:
    """Return a pose (4, 4) in a frame, without a stamp."""
    message = pose_with_covariance(pose, frame_id=frame_id)
    return PoseStamped(header=message.header, pose=message.pose.pose)


def pose_matrix(message: PoseStamped | PoseWithCovarianceStamped) -> np.ndarray:
    """Return the pose (4, 4) of a message."""
    pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
    position, orientation = pose.position, pose.orientation
    rotation = matrix_from_quaternion([orientation.x, orientation.y, orientation.z, orientation.w])
    return make_pose(rotation, [position.x, position.y, position.z])


def stamp_of(message: Any) -> str:
    """Return the stamp of a message with a header, as the localizer's diagnostics name it."""
    return stamp_text(message.header.stamp)


@dataclass(frozen=True)
class Diagnostic:
    """One status on /diagnostics.

    Attributes:
        name: of what it is a status: the node, a colon and a part of it.
        level: of DiagnosticStatus.
        reason: its message.
        values: by key.
    """

    name: str
    level: bytes
    reason: str
    values: dict[str, str]

    @property
    def ok(self) -> bool:
        return self.level == DiagnosticStatus.OK

    @property
    def part(self) -> str:
        """Which part of the node it is about: "localization", "health", "state", "index" or "map"."""
        return self.name.rpartition(": ")[2]


def read_diagnostics(message: DiagnosticArray) -> list[Diagnostic]:
    """Return the statuses of a message."""
    return [
        Diagnostic(status.name, status.level, status.message, {item.key: item.value for item in status.values})
        for status in message.status
    ]
