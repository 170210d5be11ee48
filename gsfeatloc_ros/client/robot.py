"""A simulated robot: walks through the made-up room and publishes what its camera and odometry see, in real time."""

from __future__ import annotations

import multiprocessing
import time
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovariance
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from gsfeatloc_ros.client.client_node import ClientNode
from gsfeatloc_ros.client.messages import CAMERA_FRAME, camera_info_of, pose_stamped, rgb_image
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp, so3_log
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.simulate import Room, cover
from gsfeatloc_ros.simulate.photos import Walk
from gsfeatloc_ros.simulate.room_camera import RoomCamera

# Photos of the walk. They are sent there and back again.
PHOTOS = 40
# Seconds of the walk between two where each has a prior of its own: they show more of the room.
_PHOTO_INTERVAL = 0.25
# Standard deviations of the errors of priors along and about each axis, and the correlation of one with the next.
_PRIOR_METRES, _PRIOR_DEGREES, _PRIOR_CORRELATION = 0.15, 5.0, 0.95
# Share of the motion by which odometry is off (standard deviation).
_ODOMETRY_ERROR = 0.01


@dataclass(frozen=True)
class Stream:
    """What the robot sends.

    Attributes:
        size: width and height of the images.
        rate: of them a second.
        seconds: for how long.
        tracked: whether odometry comes with each image, and a prior with the first second's alone; otherwise a prior
            comes with each.
    """

    size: tuple[int, int]
    rate: float
    seconds: float
    tracked: bool = False

    @property
    def photo_interval(self) -> float:
        """Seconds of the walk between two photos; who is tracked walks no faster than time."""
        return 1.0 / self.rate if self.tracked else _PHOTO_INTERVAL

    def true_poses(self) -> np.ndarray:
        """Return T_map_camera (PHOTOS, 4, 4) of the photos."""
        walk = Walk(np.random.default_rng(0).uniform(0, 2 * np.pi, 4))
        return np.array([walk.pose(index * self.photo_interval) for index in range(PHOTOS)])


def camera_of(size: tuple[int, int]) -> Camera:
    """Return a camera of 65 degrees with the barrel distortion of a cheap lens; `size` is its width and height."""
    width, height = size
    K = [[0.78 * width, 0.0, 0.503 * width], [0.0, 0.784 * width, 0.492 * height], [0.0, 0.0, 1.0]]
    return Camera(width, height, np.array(K), np.array([-0.28, 0.09, 0.0008, -0.0005, 0.0]))


def prepare_room(folder: Path, stream: Stream) -> tuple[Path, Path]:
    """Return the files of the map and of the photos (PHOTOS, H, W, 3) uint8 RGB; make them where they are not there."""
    folder.mkdir(parents=True, exist_ok=True)
    width, height = stream.size
    map_file = folder / "room.ply"
    photos_file = folder / f"photos_{width}x{height}_{1e3 * stream.photo_interval:.0f}ms.npy"
    if not map_file.exists():
        write_ply(map_file, cover(Room(seed=0)))
    if not photos_file.exists():
        with multiprocessing.get_context("spawn").Pool() as pool:
            np.save(photos_file, pool.map(partial(_take_photo, stream), range(PHOTOS), chunksize=1))
    return map_file, photos_file


def _take_photo(stream: Stream, index: int) -> np.ndarray:
    """Return the photo (H, W, 3) number `index`, of a camera that stands still."""
    pose, rng = stream.true_poses()[index], np.random.default_rng(index)
    return _room_camera(stream.size).photo(lambda time: pose, 0.0, rng)


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


class WheelOdometry:
    """An odometry that knows every motion but for a share of it."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._true: np.ndarray | None = None
        self._T_odom_camera = np.eye(4)

    def message(self, pose: np.ndarray) -> Odometry:
        """Return the odometry of a camera that has moved to a pose (4, 4), without a stamp."""
        if self._true is not None:
            motion, off = invert(self._true) @ pose, 1.0 + _ODOMETRY_ERROR * self._rng.standard_normal()
            rotation = so3_exp(off * so3_log(motion[:3, :3]))
            self._T_odom_camera = self._T_odom_camera @ make_pose(rotation, off * motion[:3, 3])
        self._true = pose
        stamped = pose_stamped(self._T_odom_camera, "odom")
        odometry = Odometry(header=stamped.header, child_frame_id=CAMERA_FRAME)
        odometry.pose = PoseWithCovariance(pose=stamped.pose)
        return odometry


def run_robot(photos_file: Path, stream: Stream) -> None:
    """Publish a stream of images, with what belongs to them, once somebody listens to all topics.

    For a process of its own: nothing else may delay the camera.
    """
    robot = ClientNode("robot")
    create = robot.node.create_publisher
    image = create(Image, "image", qos_profile_sensor_data)
    camera_info = create(CameraInfo, "camera_info", qos_profile_sensor_data)
    prior, odom = create(PoseStamped, "prior", 5), create(Odometry, "odom", qos_profile_sensor_data)
    ground_truth = create(PoseStamped, "ground_truth", 100)
    images, info = list(map(rgb_image, np.load(photos_file))), camera_info_of(camera_of(stream.size))
    poses, drift, odometry = stream.true_poses(), Drift(0), WheelOdometry(0)
    there_and_back = [*range(PHOTOS), *range(PHOTOS - 2, 0, -1)]
    needed = [image, camera_info, prior, ground_truth, *([odom] if stream.tracked else [])]
    while not all(publisher.get_subscription_count() for publisher in needed):
        time.sleep(0.1)
    start = time.monotonic()
    for number in range(int(stream.seconds * stream.rate)):
        time.sleep(max(0.0, start + number / stream.rate - time.monotonic()))
        index, stamp = there_and_back[number % len(there_and_back)], robot.node.get_clock().now().to_msg()
        messages = [(ground_truth, pose_stamped(poses[index])), (camera_info, info)]
        if stream.tracked:
            messages.append((odom, odometry.message(poses[index])))
        if not stream.tracked or number < stream.rate:
            messages.append((prior, pose_stamped(drift.add_to(poses[index]))))
        for publisher, message in (*messages, (image, images[index])):
            message.header.stamp = stamp
            publisher.publish(message)
    # What is reliable is to arrive.
    time.sleep(2.0)
    robot.close()
