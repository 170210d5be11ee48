"""The installed localizer watches itself: a robot of which one thing is wrong, and what its node says."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from node_harness import TIMEOUT, Client, connected_client, odometry, running_localizer
from transforms import transform_stamped

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image
from gsfeatloc_ros.client.robot import camera_of
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose
from gsfeatloc_ros.simulate.photos import Walk
from gsfeatloc_ros.simulate.room_camera import RoomCamera

# Last: a tf2_ros that is installed comes before it.
sys.path.append(str(Path(__file__).parents[1] / "support" / "tf2_stand_in"))
import tf2_ros
from tf2_msgs.msg import TFMessage

SIZE = (480, 360)
FOCAL_LENGTH = camera_of(SIZE).K[0, 0]
LONGER = r"the focal length fits [\d.]+ \+- [\d.]+ % longer than camera_info says"
# Seconds between photos; of odometry, and how far that is ahead.
INTERVAL, PERIOD, AHEAD = 0.6, 0.05, 0.4
START = 5000.0
PHOTOS = 40
WALK = Walk(np.array([0.3, 1.0, 2.0, 0.5]))
# The base is behind the camera and below it; x is ahead.
T_BASE_CAMERA = make_pose([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], [0.2, 0.0, 0.4])


# Takes the photo (H, W, 3) of a number.
TakePhoto: TypeAlias = Callable[[int], np.ndarray]


@dataclass(frozen=True)
class Robot:
    """What is wrong: the scale that the map is said to have, seconds by which images are stamped late, metres by which
    the camera is further ahead than tf says, and the share by which its focal length is longer than camera_info says.
    """

    scale: float = 1.0
    late: float = 0.0
    ahead: float = 0.0
    focal: float = 0.0


def time(seconds: float) -> Time:
    return Time(sec=int(seconds), nanosec=round(1e9 * (seconds % 1.0)))


@pytest.fixture(scope="module")
def take_photo(room) -> TakePhoto:
    """Takes the photo of a number, once: it costs time."""
    camera = RoomCamera(room, camera_of(SIZE))
    return cache(lambda number: camera.photo(WALK.pose, number * INTERVAL, np.random.default_rng(number)))


@pytest.fixture
def tf(monkeypatch):
    """Let the localizer find tf2_ros."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([os.environ["PYTHONPATH"], sys.path[-1]]))


@contextmanager
def driven(
    room_map_file: Path, take_photo: TakePhoto, robot: Robot, until: str | None = None
) -> Iterator[tuple[Client, list[TFMessage]]]:
    """Drive through the room until the health says something, or to the end."""
    T_base_camera = T_BASE_CAMERA @ make_pose(np.eye(3), [0.0, 0.0, robot.ahead])
    parameters = {
        "map__scale": robot.scale,
        "track": True,
        "map__aligned": True,
        "publish_tf": True,
        "index__build": False,
    }
    with running_localizer(map__path=room_map_file, **parameters) as process, connected_client() as client:
        static, moving = tf2_ros.StaticTransformBroadcaster(client.node), tf2_ros.TransformBroadcaster(client.node)
        static.sendTransform(transform_stamped("base_link", "camera_optical", T_BASE_CAMERA, client.next_stamp()))
        heard = client.listen(TFMessage, "/tf")
        client.send_camera_info(camera_info_of(calibrated(robot.focal)))
        first = WALK.pose(0.0)
        first[:3, 3] *= robot.scale
        client.send_prior(pose_stamped(first))
        told = client.publisher("odom", Odometry)
        moment = -AHEAD
        for number in range(PHOTOS):
            while moment < number * INTERVAL + AHEAD:
                T_odom_base = invert(WALK.pose(0.0)) @ WALK.pose(moment) @ invert(T_base_camera)
                stamp = time(START + moment)
                told.publish(odometry(T_odom_base, stamp, "base_link"))
                moving.sendTransform(transform_stamped("odom", "base_link", T_odom_base, stamp))
                client.spin_once(0.002)
                moment += PERIOD
            client.spin(0.1)
            image = rgb_image(take_photo(number))
            image.header.stamp = time(START + number * INTERVAL + robot.late)
            client.send_image(image)
            assert client.is_tried(image, TIMEOUT), process.output
            if until and client.health and until in client.health[-1].reason:
                break
        client.spin(2.5)
        yield client, heard


def calibrated(focal: float) -> Camera:
    """Return the camera as camera_info has it, where it is that much longer."""
    camera = camera_of(SIZE)
    return replace(camera, K=np.diag([1 / (1 + focal), 1 / (1 + focal), 1.0]) @ camera.K + off_centre(camera.K, focal))


def off_centre(K: np.ndarray, focal: float) -> np.ndarray:
    """Return what keeps the principal point where it is."""
    moved = np.zeros((3, 3))
    moved[:2, 2] = K[:2, 2] * focal / (1 + focal)
    return moved


def test_a_wrong_scale_is_named_and_no_transform_is_broadcast(tf, room_map_file, take_photo):
    with driven(room_map_file, take_photo, Robot(scale=1.3), "odometry says") as (client, heard):
        said = re.search(r"odometry says map.scale ([\d.]+) \+- ([\d.]+), not 1.3", client.health[-1].reason)
        assert said, client.health[-1]
        assert float(said[1]) == pytest.approx(1.0, rel=0.05)
        assert "no transform is broadcast: odometry says map.scale" in client.states[-1].reason
        count = sum(t.child_frame_id == "odom" for message in heard for t in message.transforms)
        assert count > 0
        client.spin(1.0)
        assert sum(t.child_frame_id == "odom" for message in heard for t in message.transforms) == count


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("robot", "says", "value", "off"),
    [
        # The value to set has more digits than the percentage: a tenth of the 2 % that it is off.
        (Robot(focal=0.02), rf"{LONGER}, by \d+ answers \(fx ([\d.]+),", FOCAL_LENGTH, 0.002),
        (Robot(late=0.08), r"odometry says that images are ([\d.]+) \+- [\d.]+ s late", 0.08, 0.1),
        (Robot(ahead=0.05), r"odometry says that the camera is ([\d.]+) \+- [\d.]+ m further forward", 0.05, 0.1),
    ],
    ids=["focal length", "delay", "mounting"],
)
def test_what_else_is_wrong_is_named(tf, room_map_file, take_photo, robot, says, value, off):
    with driven(room_map_file, take_photo, robot) as (client, _):
        said = re.search(says, client.health[-1].reason)
        assert said, client.health[-1]
        assert float(said[1]) == pytest.approx(value, rel=off)


@pytest.mark.nightly
def test_nothing_is_said_where_all_is_right(tf, room_map_file, take_photo):
    with driven(room_map_file, take_photo, Robot()) as (client, _):
        assert client.health[-1].ok, client.health[-1]
        assert int(client.health[-1].values["odometry_answers"]) > 20
