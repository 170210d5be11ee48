"""Messages as far as ros_io reads them, without ROS: times in seconds, poses (4, 4)."""

from __future__ import annotations

from types import SimpleNamespace as Message

import numpy as np

from gsfeatloc_ros.common.geometry import quaternion_from_matrix

SECOND = 1_000_000_000


def stamp(seconds: float) -> Message:
    nanoseconds = round(seconds * SECOND)
    return Message(sec=nanoseconds // SECOND, nanosec=nanoseconds % SECOND)


def header(seconds: float, frame: str) -> Message:
    return Message(stamp=stamp(seconds), frame_id=frame)


def pose_fields(pose: np.ndarray) -> Message:
    x, y, z, w = quaternion_from_matrix(pose[:3, :3])
    position = Message(x=pose[0, 3], y=pose[1, 3], z=pose[2, 3])
    return Message(position=position, orientation=Message(x=x, y=y, z=z, w=w))


def prior(seconds: float, pose: np.ndarray, frame: str = "map", covariance: np.ndarray | None = None) -> Message:
    if covariance is None:
        return Message(header=header(seconds, frame), pose=pose_fields(pose))
    fields = Message(pose=pose_fields(pose), covariance=covariance.ravel().tolist())
    return Message(header=header(seconds, frame), pose=fields)


def odometry(seconds: float, pose: np.ndarray, child: str = "base_link") -> Message:
    fields = Message(pose=pose_fields(pose), covariance=[0.0] * 36)
    return Message(header=header(seconds, "odom"), child_frame_id=child, pose=fields)


def camera_info(width: int = 8, height: int = 6) -> Message:
    roi = Message(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    k = [10.0, 0, 4, 0, 10, 3, 0, 0, 1]
    return Message(
        width=width, height=height, k=k, d=[], p=[0.0] * 12, distortion_model="", roi=roi, binning_x=0, binning_y=0
    )


def image(seconds: float, frame: str = "camera") -> Message:
    return Message(
        header=header(seconds, frame), width=8, height=6, encoding="mono8", is_bigendian=0, step=8, data=bytes(48)
    )
