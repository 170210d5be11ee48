"""The fields of ROS messages that are used here.

They are protocols, not the classes themselves: a message may be one of rclpy or one that rosbags read from a bag, and
ROS need not be installed.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np

# What holds bytes: array.array in rclpy's messages, np.ndarray in those of rosbags.
Bytes: TypeAlias = "bytes | bytearray | memoryview | array[int] | np.ndarray"


class Time(Protocol):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(Protocol):
    """std_msgs/Header."""

    stamp: Time
    frame_id: str


class Image(Protocol):
    """sensor_msgs/Image."""

    header: Header
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: Bytes


@runtime_checkable
class CompressedImage(Protocol):
    """sensor_msgs/CompressedImage."""

    header: Header
    format: str
    data: Bytes


class RegionOfInterest(Protocol):
    """sensor_msgs/RegionOfInterest."""

    x_offset: int
    y_offset: int
    height: int
    width: int
    do_rectify: bool


class CameraInfo(Protocol):
    """sensor_msgs/CameraInfo."""

    header: Header
    height: int
    width: int
    distortion_model: str
    d: Sequence[float] | np.ndarray
    k: Sequence[float] | np.ndarray
    p: Sequence[float] | np.ndarray
    binning_x: int
    binning_y: int
    roi: RegionOfInterest


class Point(Protocol):
    """geometry_msgs/Point."""

    x: float
    y: float
    z: float


class Quaternion(Protocol):
    """geometry_msgs/Quaternion."""

    x: float
    y: float
    z: float
    w: float


class Pose(Protocol):
    """geometry_msgs/Pose."""

    position: Point
    orientation: Quaternion


@runtime_checkable
class PoseWithCovariance(Protocol):
    """geometry_msgs/PoseWithCovariance."""

    pose: Pose
    covariance: Sequence[float] | np.ndarray


class PoseStamped(Protocol):
    """geometry_msgs/PoseStamped."""

    header: Header
    pose: Pose


class PoseWithCovarianceStamped(Protocol):
    """geometry_msgs/PoseWithCovarianceStamped."""

    header: Header
    pose: PoseWithCovariance


@runtime_checkable
class Odometry(Protocol):
    """nav_msgs/Odometry."""

    header: Header
    child_frame_id: str
    pose: PoseWithCovariance


class Transform(Protocol):
    """geometry_msgs/Transform."""

    translation: Point
    rotation: Quaternion


class TransformStamped(Protocol):
    """geometry_msgs/TransformStamped."""

    header: Header
    child_frame_id: str
    transform: Transform


class Vector3(Protocol):
    """geometry_msgs/Vector3."""

    x: float
    y: float
    z: float


class Imu(Protocol):
    """sensor_msgs/Imu."""

    header: Header
    linear_acceleration: Vector3
    linear_acceleration_covariance: Sequence[float] | np.ndarray


AnyImage = Image | CompressedImage
AnyPose = PoseStamped | PoseWithCovarianceStamped
