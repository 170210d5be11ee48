"""Messages for a bag, without rclpy: stamps are in seconds, poses are T_map_camera (4, 4)."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import quaternion_from_matrix

STORE = get_typestore(Stores.ROS2_JAZZY)
CAMERA_FRAME = "camera"


def nanoseconds(stamp: float) -> int:
    """Return a stamp in seconds as ROS counts it."""
    return round(stamp * 1e9)


def make(name: str, *values: Any, **fields: Any) -> Any:
    """Return a message of a type such as "std_msgs/msg/Header"."""
    return STORE.types[name](*values, **fields)


def header(stamp: float, frame: str) -> Any:
    """Return a std_msgs/Header."""
    seconds, rest = divmod(nanoseconds(stamp), 1_000_000_000)
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest), frame_id=frame)


def pose(T_map_camera: np.ndarray) -> Any:
    """Return a geometry_msgs/Pose."""
    position = make("geometry_msgs/msg/Point", *T_map_camera[:3, 3].tolist())
    orientation = make("geometry_msgs/msg/Quaternion", *quaternion_from_matrix(T_map_camera[:3, :3]).tolist())
    return make("geometry_msgs/msg/Pose", position=position, orientation=orientation)


def pose_stamped(stamp: float, T_map_camera: np.ndarray, frame: str = "map") -> Any:
    """Return a geometry_msgs/PoseStamped."""
    return make("geometry_msgs/msg/PoseStamped", header=header(stamp, frame), pose=pose(T_map_camera))


def image(stamp: float, rgb: np.ndarray) -> Any:
    """Return a sensor_msgs/Image of pixels (H, W, 3) uint8 RGB."""
    height, width = rgb.shape[:2]
    return make(
        "sensor_msgs/msg/Image",
        header=header(stamp, CAMERA_FRAME),
        height=height,
        width=width,
        encoding="rgb8",
        is_bigendian=0,
        step=3 * width,
        data=np.ascontiguousarray(rgb).ravel(),
    )


def camera_info(stamp: float, camera: Camera) -> Any:
    """Return the sensor_msgs/CameraInfo of a camera whose images are not rectified."""
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header(stamp, CAMERA_FRAME),
        height=camera.height,
        width=camera.width,
        distortion_model=camera.model,
        d=camera.distortion,
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([camera.K, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )
