"""Decode ROS messages into the localizer's own types: here poses.

Images are decoded in raw_image.py and compressed_image.py, calibrations in calibration.py. Everything that comes from
outside is checked in these four and nowhere else: a message that cannot be used raises ValueError, which says what is
wrong and what to do about it.
"""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion
from gsfeatloc_ros.ros_io.message_types import AnyPose, Odometry, PoseWithCovariance, Time

# Of a prior, in m^2 or rad^2; a larger one says nothing, and products of it overflow.
_MAX_VARIANCE = 1e12


def decode_pose(message: AnyPose | Odometry, name: str) -> np.ndarray:
    """Return the pose (4, 4) of a message in the frame that its header names.

    A quaternion that is not of unit length is normalised. `name` is what errors call the message.

    Raises:
        ValueError: a value that is not finite, or a quaternion of zeros.
    """
    pose = message.pose.pose if isinstance(message.pose, PoseWithCovariance) else message.pose
    position, orientation = pose.position, pose.orientation
    translation = np.array([position.x, position.y, position.z])
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    if not (np.isfinite(translation).all() and np.isfinite(quaternion).all()):
        raise ValueError(
            f"{name} has position {translation.tolist()} and quaternion {quaternion.tolist()}: all must be finite"
        )
    try:
        return make_pose(matrix_from_quaternion(quaternion), translation)
    except ValueError as error:
        raise ValueError(f"{name} cannot be used: {error}") from error


def decode_covariance(message: AnyPose | Odometry, name: str) -> np.ndarray | None:
    """Return the covariance (6, 6) of a pose in ROS order; None where it is not known.

    That is so of a pose without one, and where it says so: all zeros, a variance of -1, or NaN.

    Raises:
        ValueError: a value that is infinite, or another negative variance.
    """
    if not isinstance(message.pose, PoseWithCovariance):
        return None
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    variances = covariance.diagonal()
    if not covariance.any() or np.isnan(covariance).any() or (variances == -1).any():
        return None
    if not np.isfinite(covariance).all() or variances.min() < 0:
        raise ValueError(f"{name} has covariance {covariance.tolist()}: all must be finite, and no variance negative")
    largest = np.abs(covariance).max()
    if largest > _MAX_VARIANCE:
        raise ValueError(f"{name} has covariances up to {largest:g} (at most {_MAX_VARIANCE:g}): zeros mean unknown")
    return covariance


def frame_name(frame_id: str) -> str:
    """Return the name of a frame as tf2 knows it: without the slash that tf of ROS 1 had before it."""
    return frame_id.removeprefix("/")


def nanoseconds(stamp: Time) -> int:
    """Return a stamp in nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec
