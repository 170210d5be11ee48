"""A simulated robot: walks through the made-up room and publishes what its camera and odometry see, in real time."""

from __future__ import annotations

import multiprocessing
import time
from functools import cache, partial
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from gsfeatloc_ros.client.client_node import ClientNode
from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.simulate import Room, cover
from gsfeatloc_ros.simulate.photos import Walk
from gsfeatloc_ros.simulate.room_camera import RoomCamera

# Photos of the walk, and seconds of it between two. They are sent there and back again.
PHOTOS = 40
_PHOTO_INTERVAL = 0.25
# Standard deviations of the errors of priors along and about each axis, and the correlation of one with the next.
_PRIOR_METRES, _PRIOR_DEGREES, _PRIOR_CORRELATION = 0.15, 5.0, 0.95


def camera_of(size: tuple[int, int]) -> Camera:
    """Return a camera of 65 degrees with the barrel distortion of a cheap lens; `size` is its width and height."""
    width, height = size
    K = [[0.78 * width, 0.0, 0.503 * width], [0.0, 0.784 * width, 0.492 * height], [0.0, 0.0, 1.0]]
    return Camera(width, height, np.array(K), np.array([-0.28, 0.09, 0.0008, -0.0005, 0.0]))


def true_poses() -> np.ndarray:
    """Return T_map_camera (PHOTOS, 4, 4) of the photos."""
    walk = Walk(np.random.default_rng(0).uniform(0, 2 * np.pi, 4))
    return np.array([walk.pose(index * _PHOTO_INTERVAL) for index in range(PHOTOS)])


def prepare_room(folder: Path, size: tuple[int, int]) -> tuple[Path, Path]:
    """Return the files of the map and of the photos (PHOTOS, H, W, 3) uint8 RGB; make them where they are not there."""
    folder.mkdir(parents=True, exist_ok=True)
    map_file, photos_file = folder / "room.ply", folder / f"photos_{size[0]}x{size[1]}.npy"
    if not map_file.exists():
        write_ply(map_file, cover(Room(seed=0)))
    if not photos_file.exists():
        with multiprocessing.get_context("spawn").Pool() as pool:
            np.save(photos_file, pool.map(partial(_take_photo, size), range(PHOTOS), chunksize=1))
    return map_file, photos_file


def _take_photo(size: tuple[int, int], index: int) -> np.ndarray:
    """Return the photo (H, W, 3) number `index`, of a camera that stands still."""
    pose, rng = true_poses()[index], np.random.default_rng(index)
    return _room_camera(size).photo(lambda time: pose, 0.0, rng)


@cache
def _room_camera(size: tuple[int, int]) -> RoomCamera:
    return RoomCamera(Room(seed=0), camera_of(size))


class Drift:
    """Errors of an odometry that is corrected now and then: they wander, but not away."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._sigmas = np.array([_PRIOR_METRES] * 3 + [np.radians(_PRIOR_DEGREES)] * 3)
        self._error = self._sigmas * self._rng.standard_normal(6)

    def add_to(self, pose: np.ndarray) -> np.ndarray:
        """Return the pose (4, 4) as odometry has it."""
        fresh = np.sqrt(1 - _PRIOR_CORRELATION**2) * self._sigmas * self._rng.standard_normal(6)
        self._error = _PRIOR_CORRELATION * self._error + fresh
        return make_pose(pose[:3, :3] @ so3_exp(self._error[3:]), pose[:3, 3] + self._error[:3])


def run_robot(photos_file: Path, size: tuple[int, int], rate: float, seconds: float) -> None:
    """Publish `rate` images a second, with camera_info, prior and ground_truth, once somebody listens to all of them.

    For a process of its own: nothing else may delay the camera.
    """
    robot = ClientNode("robot")
    image = robot.node.create_publisher(Image, "image", qos_profile_sensor_data)
    camera_info = robot.node.create_publisher(CameraInfo, "camera_info", qos_profile_sensor_data)
    prior = robot.node.create_publisher(PoseStamped, "prior", 5)
    ground_truth = robot.node.create_publisher(PoseStamped, "ground_truth", 100)
    images, info = list(map(rgb_image, np.load(photos_file))), camera_info_of(camera_of(size))
    poses, drift = true_poses(), Drift(0)
    there_and_back = [*range(PHOTOS), *range(PHOTOS - 2, 0, -1)]
    while not all(publisher.get_subscription_count() for publisher in (image, camera_info, prior, ground_truth)):
        time.sleep(0.1)
    start = time.monotonic()
    for number in range(int(seconds * rate)):
        time.sleep(max(0.0, start + number / rate - time.monotonic()))
        index, stamp = there_and_back[number % len(there_and_back)], robot.node.get_clock().now().to_msg()
        for publisher, message in (
            (ground_truth, pose_stamped(poses[index])),
            (camera_info, info),
            (prior, pose_stamped(drift.add_to(poses[index]))),
            (image, images[index]),
        ):
            message.header.stamp = stamp
            publisher.publish(message)
    # What is reliable is to arrive.
    time.sleep(2.0)
    robot.close()
