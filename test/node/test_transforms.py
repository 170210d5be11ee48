"""Transforms against tf over DDS: the real tf2_ros where it is installed, otherwise the one in tf2_stand_in."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import TransformStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.time import Time
from transforms import transform_stamped

from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp
from gsfeatloc_ros.node.transforms import TransformError, Transforms

# Last: a tf2_ros that is installed comes before it.
sys.path.append(str(Path(__file__).parents[1] / "support" / "tf2_stand_in"))
import tf2_ros

SECOND = 10**9
TIMEOUT = 30.0


def turn(angle: float, translation: tuple[float, float, float]) -> np.ndarray:
    """Pose (4, 4) turned about z."""
    return make_pose(so3_exp(np.array([0.0, 0.0, angle])), np.array(translation))


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return make_pose(so3_exp(rng.normal(size=3)), rng.normal(size=3))


class Robot:
    """What tells tf, and a node that listens, whose executor spins in a thread of its own."""

    def __init__(self, use_sim_time: bool = False) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        clock = Parameter("use_sim_time", value=use_sim_time)
        self.node = rclpy.create_node("listener", context=self._context, parameter_overrides=[clock])
        self.transforms = Transforms(self.node)
        self._teller = rclpy.create_node("teller", context=self._context)
        self._moving = tf2_ros.TransformBroadcaster(self._teller)
        self._static = tf2_ros.StaticTransformBroadcaster(self._teller)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def listen(self) -> None:
        """Listen, and wait until the one who tells tf was found."""
        self.transforms.listen()
        wait_for(lambda: all_heard(self._teller))

    def tell(self, parent: str, child: str, pose: np.ndarray, stamp: int) -> None:
        self._moving.sendTransform(transform_stamped(parent, child, pose, Time(nanoseconds=stamp).to_msg()))

    def tell_static(self, parent: str, child: str, pose: np.ndarray) -> None:
        self._static.sendTransform(transform_stamped(parent, child, pose, Time().to_msg()))

    def close(self) -> None:
        self._closing.set()
        self._thread.join(TIMEOUT)
        self._executor.shutdown()
        self._teller.destroy_node()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _spin(self) -> None:
        while not self._closing.is_set():
            self._executor.spin_once(timeout_sec=0.1)


def all_heard(node: rclpy.node.Node) -> bool:
    """Whether somebody listens to each of the node's publishers of transforms."""
    told = [publisher for publisher in node.publishers if publisher.topic_name in ("/tf", "/tf_static")]
    return all(publisher.get_subscription_count() for publisher in told)


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline, "not in time"
        time.sleep(0.01)


@pytest.fixture
def robot() -> Iterator[Robot]:
    robot = Robot()
    try:
        yield robot
    finally:
        robot.close()


def test_same_frame_needs_no_tf(robot, monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    assert np.array_equal(robot.transforms.lookup("map", "map", 5 * SECOND), np.eye(4))


def test_without_tf2_ros_says_what_to_install(robot, monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    for use in (
        robot.transforms.listen,
        lambda: robot.transforms.lookup("map", "odom", 0),
        lambda: robot.transforms.broadcast("map", "odom", np.eye(4), Time().to_msg()),
    ):
        with pytest.raises(TransformError, match="not installed: apt install ros-jazzy-tf2-ros-py"):
            use()


def test_unknown_frame_is_named_with_the_time_and_what_to_do(robot):
    robot.listen()
    start = time.monotonic()
    with pytest.raises(ValueError, match=r"no transform from 'camera' to 'map' at 12\.000000345 .*start what pub"):
        robot.transforms.lookup("map", "camera", 12 * SECOND + 345, timeout=0.3)
    assert 0.3 <= time.monotonic() - start < 5.0
    with pytest.raises(TransformError, match="from 'camera' to 'map' at any time"):
        robot.transforms.lookup("map", "camera", 0, timeout=0.0)


@pytest.mark.parametrize("frame", ["", "/map"])
def test_name_that_no_frame_can_have_is_refused(robot, frame):
    robot.listen()
    with pytest.raises(TransformError, match=f"'{frame}'"):
        robot.transforms.lookup(frame, "camera", 0, timeout=0.0)


def test_static_chain_at_any_time(robot):
    rng = np.random.default_rng(0)
    T_base_mast, T_mast_camera = random_pose(rng), random_pose(rng)
    robot.tell_static("base_link", "mast", T_base_mast)
    robot.tell_static("mast", "camera", T_mast_camera)
    robot.listen()  # after they were told: /tf_static is kept for those who come later
    for stamp in (0, SECOND, 2_000_000_000 * SECOND):
        found = robot.transforms.lookup("base_link", "camera", stamp, TIMEOUT)
        np.testing.assert_allclose(found, T_base_mast @ T_mast_camera, atol=1e-9)
        np.testing.assert_allclose(robot.transforms.lookup("camera", "base_link", stamp), invert(found), atol=1e-9)


def test_between_two_stamps_it_is_interpolated(robot):
    robot.listen()
    robot.tell("odom", "base_link", turn(0.2, (1.0, 0.0, 0.0)), 10 * SECOND)
    robot.tell("odom", "base_link", turn(1.0, (3.0, 4.0, 0.0)), 12 * SECOND)
    found = robot.transforms.lookup("odom", "base_link", 10 * SECOND + SECOND // 2, TIMEOUT)
    np.testing.assert_allclose(found, turn(0.4, (1.5, 1.0, 0.0)), atol=1e-9)


def test_rotation_is_interpolated_the_short_way(robot):
    robot.listen()
    robot.tell("odom", "base_link", turn(3.0, (0.0, 0.0, 0.0)), 10 * SECOND)
    robot.tell("odom", "base_link", turn(-3.0, (0.0, 0.0, 0.0)), 12 * SECOND)
    found = robot.transforms.lookup("odom", "base_link", 11 * SECOND, TIMEOUT)
    np.testing.assert_allclose(found, turn(np.pi, (0.0, 0.0, 0.0)), atol=1e-9)


def test_newest_is_of_the_newest_time_that_all_frames_have(robot):
    robot.listen()
    T_base_camera = turn(0.5, (0.1, 0.2, 0.3))
    robot.tell_static("base_link", "camera", T_base_camera)
    robot.tell("map", "odom", turn(0.0, (5.0, 0.0, 0.0)), 10 * SECOND)
    for second in (9, 11):
        robot.tell("odom", "base_link", turn(0.0, (0.0, float(second), 0.0)), second * SECOND)
    robot.transforms.lookup("odom", "camera", 11 * SECOND, TIMEOUT)
    found = robot.transforms.lookup("map", "camera", 0, TIMEOUT)
    np.testing.assert_allclose(found, turn(0.0, (5.0, 10.0, 0.0)) @ T_base_camera, atol=1e-9)


def test_lookup_waits_for_what_comes_later(robot):
    robot.listen()
    robot.tell("odom", "base_link", turn(0.0, (1.0, 0.0, 0.0)), 10 * SECOND)
    robot.transforms.lookup("odom", "base_link", 10 * SECOND, TIMEOUT)
    later = threading.Timer(0.3, robot.tell, ("odom", "base_link", turn(0.0, (2.0, 0.0, 0.0)), 11 * SECOND))
    later.start()
    start = time.monotonic()
    found = robot.transforms.lookup("odom", "base_link", 11 * SECOND, TIMEOUT)
    assert time.monotonic() - start > 0.2
    assert found[0, 3] == 2.0


def test_a_time_that_is_not_reached_is_an_error(robot):
    robot.listen()
    for second in (10, 11):
        robot.tell("odom", "base_link", np.eye(4), second * SECOND)
    robot.transforms.lookup("odom", "base_link", 11 * SECOND, TIMEOUT)
    for second, direction in ((9, "past"), (12, "future")):
        with pytest.raises(TransformError, match=f"'odom' at {second}.0+ .*extrapolation into the {direction}"):
            robot.transforms.lookup("odom", "base_link", second * SECOND, timeout=0.1)


def test_frames_of_two_trees_are_an_error(robot):
    robot.listen()
    robot.tell_static("map", "odom", np.eye(4))
    robot.tell_static("base_link", "camera", np.eye(4))
    robot.transforms.lookup("base_link", "camera", 0, TIMEOUT)
    with pytest.raises(TransformError, match="from 'camera' to 'map'"):
        robot.transforms.lookup("map", "camera", 0, timeout=0.1)


def test_a_clock_that_stands_still_holds_nothing_up():
    robot = Robot(use_sim_time=True)
    try:
        robot.listen()
        start = time.monotonic()
        with pytest.raises(TransformError):
            robot.transforms.lookup("map", "camera", SECOND, timeout=0.3)
        assert time.monotonic() - start < 5.0
    finally:
        robot.close()


def test_forget_drops_what_moved_and_takes_older_stamps_again(robot):
    robot.transforms.forget()  # nothing to forget yet
    robot.listen()
    robot.tell_static("base_link", "camera", turn(0.0, (0.0, 0.0, 1.0)))
    robot.tell("odom", "base_link", turn(0.0, (1.0, 0.0, 0.0)), 1000 * SECOND)
    robot.transforms.lookup("odom", "camera", 1000 * SECOND, TIMEOUT)
    robot.transforms.forget()
    with pytest.raises(TransformError):
        robot.transforms.lookup("odom", "base_link", 0, timeout=0.1)
    assert robot.transforms.lookup("base_link", "camera", 5 * SECOND)[2, 3] == 1.0
    robot.tell("odom", "base_link", turn(0.0, (2.0, 0.0, 0.0)), 5 * SECOND)
    np.testing.assert_array_equal(
        robot.transforms.lookup("odom", "camera", 5 * SECOND, TIMEOUT)[:3, 3], [2.0, 0.0, 1.0]
    )


def test_infinite_translation_is_refused(robot):
    robot.listen()
    robot.tell_static("map", "odom", turn(0.0, (np.inf, 0.0, 0.0)))
    with pytest.raises(TransformError, match=r"'odom' to 'map' has translation .*must be finite"):
        robot.transforms.lookup("map", "odom", 0, TIMEOUT)


def test_listening_twice_subscribes_once(robot):
    robot.listen()
    robot.transforms.listen()
    time.sleep(0.2)
    assert robot.node.count_subscribers("/tf") == 1
    assert robot.node.count_subscribers("/tf_static") == 1


def test_broadcast_arrives_as_it_was_sent(robot):
    robot.listen()
    T_map_odom = random_pose(np.random.default_rng(1))
    stamp = 7 * SECOND + 1
    robot.transforms.broadcast("map", "odom", T_map_odom, Time(nanoseconds=stamp).to_msg())
    wait_for(lambda: all_heard(robot.node))
    robot.transforms.broadcast("map", "odom", T_map_odom, Time(nanoseconds=stamp).to_msg())
    found = robot.transforms.lookup("map", "odom", stamp, TIMEOUT)
    np.testing.assert_allclose(found, T_map_odom, atol=1e-9)


@settings(deadline=None)
@given(st.lists(st.integers(0, 5), min_size=1, max_size=5), st.integers(0, 2**32 - 1), st.data())
def test_any_tree_gives_what_the_chain_of_its_poses_gives(parents, seed, data):
    """Frame i + 1 hangs on one of the frames before it; half of the edges are static."""
    rng = np.random.default_rng(seed)
    buffer = tf2_ros.Buffer()
    T_root = [np.eye(4)]
    for child, parent in enumerate(parents, start=1):
        parent %= child
        pose = random_pose(rng)
        T_root.append(T_root[parent] @ pose)
        if rng.random() < 0.5:
            buffer.set_transform_static(transform_stamped(f"f{parent}", f"f{child}", pose, Time().to_msg()), "test")
        else:
            buffer.set_transform(transform_stamped(f"f{parent}", f"f{child}", pose, Time(seconds=3).to_msg()), "test")
    target, source = (data.draw(st.integers(0, len(parents))) for _ in range(2))
    for stamp in (0, 3 * SECOND):
        found = buffer.lookup_transform(f"f{target}", f"f{source}", Time(nanoseconds=stamp))
        np.testing.assert_allclose(matrix(found), invert(T_root[target]) @ T_root[source], atol=1e-7)


def matrix(message: TransformStamped) -> np.ndarray:
    """Pose (4, 4) from the quaternion's rotation of the three axes, as q v q* gives it."""
    t, q = message.transform.translation, message.transform.rotation
    vector = np.array([q.x, q.y, q.z])
    axes = np.eye(3)
    doubled = 2.0 * np.cross(vector, axes)
    return make_pose((axes + q.w * doubled + np.cross(vector, doubled)).T, np.array([t.x, t.y, t.z]))


@pytest.mark.parametrize("rotation", [(0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0), (np.inf, 0.0, 0.0, 1.0)])
def test_a_quaternion_without_direction_is_ignored(rotation):
    buffer = tf2_ros.Buffer()
    buffer.set_transform(rotated("map", "odom", rotation), "test")
    assert not buffer.can_transform("map", "odom", Time())


def test_a_quaternion_of_another_length_is_normalised():
    buffer = tf2_ros.Buffer()
    buffer.set_transform(rotated("map", "odom", (1.0, 1.0, 1.0, 1.0)), "test")
    cyclic = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]  # a third of a turn about the diagonal
    found = buffer.lookup_transform("map", "odom", Time())
    np.testing.assert_allclose(matrix(found)[:3, :3], cyclic, atol=1e-9)


def rotated(parent: str, child: str, rotation: tuple[float, float, float, float]) -> TransformStamped:
    message = transform_stamped(parent, child, np.eye(4), Time(seconds=1).to_msg())
    into = message.transform.rotation
    into.x, into.y, into.z, into.w = rotation
    return message
