"""Write simulated photos as a rosbag2, as a robot would have recorded them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin, Writer

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.simulate.bag_messages import STORE, camera_info, image, nanoseconds, pose_stamped
from gsfeatloc_ros.simulate.photos import SimulatedPhoto

IMAGE_TOPIC = "/camera/image_raw"
CAMERA_INFO_TOPIC = "/camera/camera_info"
PRIOR_TOPIC = "/prior"
TRUTH_TOPIC = "/ground_truth"


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
            topic: writer.add_connection(topic, message_type, typestore=STORE)
            for topic, message_type in (
                (PRIOR_TOPIC, "geometry_msgs/msg/PoseStamped"),
                (CAMERA_INFO_TOPIC, "sensor_msgs/msg/CameraInfo"),
                (IMAGE_TOPIC, "sensor_msgs/msg/Image"),
                (TRUTH_TOPIC, "geometry_msgs/msg/PoseStamped"),
            )
        }
        for photo in photos:
            messages = {
                PRIOR_TOPIC: pose_stamped(photo.stamp, photo.T_map_camera_prior),
                CAMERA_INFO_TOPIC: camera_info(photo.stamp, camera),
                IMAGE_TOPIC: image(photo.stamp, photo.image),
                TRUTH_TOPIC: pose_stamped(photo.stamp, photo.T_map_camera),
            }
            for topic, message in messages.items():
                cdr = STORE.serialize_cdr(message, message.__msgtype__)
                writer.write(connections[topic], nanoseconds(photo.stamp), cdr)
