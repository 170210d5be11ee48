"""Write simulated photos as a rosbag2, as a robot would have recorded them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import quaternion_from_matrix
from gsfeatloc_ros.simulate.photos import SimulatedPhoto

IMAGE_TOPIC = "/camera/image_raw"
CAMERA_INFO_TOPIC = "/camera/camera_info"
PRIOR_TOPIC = "/prior"
TRUTH_TOPIC = "/ground_truth"

_TYPES = get_typestore(Stores.ROS2_JAZZY)


def nanoseconds(stamp: float) -> int:
    """A stamp in seconds as ROS counts it."""
    return round(stamp * 1e9)


def write_bag(
    path: str | Path, camera: Camera, photos: Sequence[SimulatedPhoto], storage: StoragePlugin = StoragePlugin.MCAP
) -> None:
    """Write a new rosbag2 folder: of each photo its prior, camera info and image, and the true pose.

    All four carry the stamp of the photo; images are rgb8, poses PoseStamped in the frame `map`.

    Raises:
        rosbags.rosbag2.WriterError: the path exists.
    """
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {
            topic: writer.add_connection(topic, message_type, typestore=_TYPES)
            for topic, message_type in (
                (PRIOR_TOPIC, "geometry_msgs/msg/PoseStamped"),
                (CAMERA_INFO_TOPIC, "sensor_msgs/msg/CameraInfo"),
                (IMAGE_TOPIC, "sensor_msgs/msg/Image"),
                (TRUTH_TOPIC, "geometry_msgs/msg/PoseStamped"),
            )
        }
        for photo in photos:
            messages = {
                PRIOR_TOPIC: _pose(photo.stamp, photo.T_map_camera_prior),
                CAMERA_INFO_TOPIC: _camera_info(photo.stamp, camera),
                IMAGE_TOPIC: _image(photo.stamp, photo.image),
                TRUTH_TOPIC: _pose(photo.stamp, photo.T_map_camera),
            }
            for topic, message in messages.items():
                cdr = _TYPES.serialize_cdr(message, message.__msgtype__)
                writer.write(connections[topic], nanoseconds(photo.stamp), cdr)


def _header(stamp: float, frame: str) -> object:
    seconds, rest = divmod(nanoseconds(stamp), 1_000_000_000)
    time = _TYPES.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    return _TYPES.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _pose(stamp: float, T_map_camera: np.ndarray) -> object:
    types = _TYPES.types
    position = types["geometry_msgs/msg/Point"](*T_map_camera[:3, 3].tolist())
    orientation = types["geometry_msgs/msg/Quaternion"](*quaternion_from_matrix(T_map_camera[:3, :3]).tolist())
    pose = types["geometry_msgs/msg/Pose"](position=position, orientation=orientation)
    return types["geometry_msgs/msg/PoseStamped"](header=_header(stamp, "map"), pose=pose)


def _image(stamp: float, image: np.ndarray) -> object:
    height, width = image.shape[:2]
    return _TYPES.types["sensor_msgs/msg/Image"](
        header=_header(stamp, "camera"),
        height=height,
        width=width,
        encoding="rgb8",
        is_bigendian=0,
        step=3 * width,
        data=np.ascontiguousarray(image).ravel(),
    )


def _camera_info(stamp: float, camera: Camera) -> object:
    types = _TYPES.types
    return types["sensor_msgs/msg/CameraInfo"](
        header=_header(stamp, "camera"),
        height=camera.height,
        width=camera.width,
        distortion_model=camera.model,
        d=camera.distortion,
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([camera.K, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )
