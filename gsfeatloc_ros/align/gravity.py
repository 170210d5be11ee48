"""Which way is up in the map's frame: by an accelerometer, or by a camera that is mounted level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.align.fit import UndeterminedError
from gsfeatloc_ros.align.pairs import Answer
from gsfeatloc_ros.align.robot_path import RobotPath
from gsfeatloc_ros.replay.bag import Role, open_bag
from gsfeatloc_ros.replay.bag_files import BagError
from gsfeatloc_ros.ros_io.decode import frame_name, nanoseconds

# m/s^2. Standard gravity, and by how much a mean that differs is one of a robot that speeds up, or falls.
_GRAVITY, _MAX_OFF = 9.81, 0.5
# Nanoseconds round a photo of which the mean is taken: motors shake.
_WINDOW = 250_000_000
# Mean square sine of the turn between headings: some ten degrees this way and that.
_LEAST_TURN = 0.03


@dataclass(frozen=True, eq=False)
class Up:
    """A direction.

    Attributes:
        direction: (3,) unit vector, frame in which the map lies.
        sigma: standard deviation of its angle in radians, by how far the photos differ.
        photos: their number.
    """

    direction: np.ndarray
    sigma: float
    photos: int


def up_of_level_camera(answers: Sequence[Answer]) -> Up:
    """Return what is up where the rows of the photos are level, whatever the camera's pitch.

    That is the direction that the x axes of all cameras are perpendicular to.

    Raises:
        UndeterminedError: the cameras all looked one way, or the other.
    """
    axes = np.array([answer.T_map_camera[:3, 0] for answer in answers])
    squares, directions = np.linalg.eigh(axes.T @ axes)
    if squares[1] < _LEAST_TURN * len(answers):
        raise UndeterminedError("the camera looked in one direction only: without a turn nothing tells what is up")
    up = directions[:, 0]
    if up @ np.sum([answer.T_map_camera[:3, 1] for answer in answers], axis=0) > 0:
        up = -up
    variance = max(float(squares[0]), 0.0) / max(len(answers) - 2, 1)
    return Up(up, float(np.sqrt(variance / squares[1] + variance / squares[2])), len(answers))


def up_by_imu(answers: Sequence[Answer], path: RobotPath, topic: str) -> Up:
    """Return what is up by the accelerometer at the time of each photo.

    Args:
        answers: where the photos were taken.
        path: with the bag, and where the camera is in the IMU's frame, or its frame in tf.
        topic: of sensor_msgs/Imu.

    Raises:
        BagError: the bag has no accelerations, or nothing says how the IMU is mounted.
        UndeterminedError: there is no photo at whose time the robot was at rest or went evenly.
    """
    stamps, accelerations, frame = _accelerations(path, topic)
    T_imu_camera = path.mounted(frame)
    directions = []
    for answer in answers:
        start, end = np.searchsorted(stamps, [answer.stamp - _WINDOW, answer.stamp + _WINDOW])
        if start < end:
            force = accelerations[start:end].mean(axis=0)
            if abs(np.linalg.norm(force) - _GRAVITY) < _MAX_OFF:
                in_camera = T_imu_camera[:3, :3].T @ force
                directions.append(answer.T_map_camera[:3, :3] @ in_camera / np.linalg.norm(force))
    return _mean(directions)


def _mean(directions: Sequence[np.ndarray]) -> Up:
    if not directions:
        raise UndeterminedError("no photo tells what is up: none was localized while the robot stood or went evenly")
    total = np.sum(directions, axis=0)
    up = total / max(float(np.linalg.norm(total)), 1e-12)
    angles = np.arccos(np.clip(np.array(directions) @ up, -1, 1))
    spread = float(np.sqrt(np.mean(angles**2)))
    return Up(up, spread / np.sqrt(max(len(directions) - 1, 1)), len(directions))


def _accelerations(path: RobotPath, topic: str) -> tuple[np.ndarray, np.ndarray, str]:
    """Return stamps (N,) in nanoseconds, accelerations (N, 3) and the frame of the IMU."""
    stamps, values, frame = [], [], ""
    with open_bag(path.bag, {Role.IMU: [topic]}) as bag:
        for recorded in bag.messages():
            message = recorded.message
            if message is None:
                continue
            if message.linear_acceleration_covariance[0] == -1:
                raise BagError(f"{path.bag}: {topic} says that it has no accelerations (covariance -1)")
            force = message.linear_acceleration
            frame = frame_name(message.header.frame_id)
            stamps.append(nanoseconds(message.header.stamp))
            values.append([force.x, force.y, force.z])
    found = np.array(values).reshape(-1, 3)
    usable = np.isfinite(found).all(axis=1)
    if not usable.any():
        raise BagError(f"{path.bag}: {topic} has no accelerations")
    order = np.argsort(np.array(stamps)[usable], kind="stable")
    return np.array(stamps)[usable][order], found[usable][order], frame
