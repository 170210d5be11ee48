"""Where parts of the robot are, as far as an answer needs it: the base, and the frame of the odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.geometry import flattened, invert, shift_covariance
from gsfeatloc_ros.ros_io.decode import frame_name, nanoseconds
from gsfeatloc_ros.ros_io.inputs import Lookup
from gsfeatloc_ros.ros_io.message_types import Header


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """Where parts of the robot were at an image's stamp, as far as it is needed to publish the answer.

    Attributes:
        T_camera_body: (4, 4) of the body that answers are poses of: the base, or the camera itself.
        T_camera_odom: (4, 4) of the odometry's frame; None where no transform is broadcast.
        T_camera_base: (4, 4) of the base; None unless the transform is kept flat.
    """

    T_camera_body: np.ndarray
    T_camera_odom: np.ndarray | None
    T_camera_base: np.ndarray | None

    def T_map_odom(self, T_map_camera: np.ndarray) -> np.ndarray | None:
        """Return the transform (4, 4) that follows from a pose (4, 4) of the camera; None where none is broadcast."""
        if self.T_camera_odom is None:
            return None
        if self.T_camera_base is None:
            return T_map_camera @ self.T_camera_odom
        T_odom_base = invert(self.T_camera_odom) @ self.T_camera_base
        return flattened(T_map_camera @ self.T_camera_base) @ invert(flattened(T_odom_base))

    def of_body(self, T_map_camera: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose (4, 4) of the body, with its covariance (6, 6), where those of the camera are these."""
        T_map_body = T_map_camera @ self.T_camera_body
        return T_map_body, shift_covariance(covariance, T_map_body[:3, 3] - T_map_camera[:3, 3])


@dataclass(frozen=True)
class AnswerFrames:
    """Which frames answers need.

    Attributes:
        body: frame that answers are poses of; empty for the camera's.
        odom: frame of the odometry, to which a transform is broadcast; empty where none is.
        flat_base: frame of the base, if that transform is kept flat; else empty.
    """

    body: str = ""
    odom: str = ""
    flat_base: str = ""

    def extrinsics(self, lookup: Lookup, header: Header, shared: bool = True) -> Extrinsics:
        """Look up what is needed to publish the answer to an image.

        Args:
            lookup: of the robot's frames.
            header: the image's.
            shared: whether the answer is for all, tf among them.

        Raises:
            ValueError: `lookup` does not know it.
        """

        def T_camera(frame: str) -> np.ndarray:
            return lookup(frame_name(header.frame_id), frame, nanoseconds(header.stamp))

        broadcast = self.odom and shared
        return Extrinsics(
            T_camera(self.body) if self.body else np.eye(4),
            T_camera(self.odom) if broadcast else None,
            T_camera(self.flat_base) if broadcast and self.flat_base else None,
        )
