"""Play a recorded bag into a running localizer, photo by photo, and collect its answers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import CameraInfo, Image

from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion
from gsfeatloc_ros.node.diagnostics import stamp_text

# Seconds from a photo's prior and camera info to the photo itself: topics have no order, and it must not overtake them.
# (To wait for their acknowledgment would take seconds: it comes with Fast DDS's heartbeat.)
_HEAD_START = 0.1
# Seconds that the localizer may need to find the player after the player has found it.
_SETTLING = 0.5


@dataclass(frozen=True)
class Topics:
    """Names of the topics in the bag, on which the localizer listens too."""

    image: str
    camera_info: str
    prior: str


@dataclass(frozen=True, eq=False)
class Answer:
    """What the localizer said to one photo.

    Attributes:
        stamp: of the photo, seconds with nine decimals.
        T_map_camera: (4, 4) pose that was published; None when there was none.
        evidence: the values of the localizer's diagnostic by key (status, reason, inliers ...); empty without answer.
        milliseconds: wall time from sending the photo until the answer had come; NaN without answer.
    """

    stamp: str
    T_map_camera: np.ndarray | None
    evidence: dict[str, str]
    milliseconds: float


def play_bag(
    path: str | Path,
    topics: Topics,
    is_running: Callable[[], bool],
    start_timeout: float = 180.0,
    answer_timeout: float = 30.0,
) -> Iterator[Answer]:
    """Publish every photo of a bag, after its camera info and prior, and yield the localizer's answer to it.

    The next photo is sent when the answer is there, or after `answer_timeout` seconds without one.

    Args:
        path: rosbag2 folder.
        topics: which topics to play.
        is_running: whether the localizer still runs; asked while waiting for it.
        start_timeout: seconds that the localizer may take to appear; it compiles its kernels at the first start.

    Raises:
        RuntimeError: the localizer ended.
        TimeoutError: the localizer did not appear on its topics.
    """
    context = rclpy.Context()
    rclpy.init(context=context)
    player = _Player(topics, is_running, context)
    try:
        player.wait_for_localizer(start_timeout)
        with Reader(path) as bag:
            played = [connection for connection in bag.connections if connection.topic in player.publishers]
            for connection, _, cdr in bag.messages(played):
                if connection.topic == topics.image:
                    yield player.ask(bytes(cdr), answer_timeout)
                else:
                    player.publishers[connection.topic].publish(bytes(cdr))
    finally:
        player.close()
        rclpy.shutdown(context=context)


class _Player:
    """A node that publishes the bag's topics and remembers what the localizer says."""

    def __init__(self, topics: Topics, is_running: Callable[[], bool], context: rclpy.Context) -> None:
        self._topics, self._is_running = topics, is_running
        self._poses: dict[str, np.ndarray] = {}
        self._evidence: dict[str, dict[str, str]] = {}
        self._node = rclpy.create_node("bag_player", context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)
        types = {topics.image: Image, topics.camera_info: CameraInfo, topics.prior: PoseStamped}
        self.publishers = {topic: self._node.create_publisher(kind, topic, 10) for topic, kind in types.items()}
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._subscriptions = (
            self._node.create_subscription(PoseWithCovarianceStamped, "pose", self._on_pose, latched),
            self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100),
        )

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()

    def wait_for_localizer(self, timeout: float) -> None:
        """Wait until the localizer hears all topics and is heard on its own."""
        found = self._spin_until(
            lambda: (
                all(publisher.get_subscription_count() for publisher in self.publishers.values())
                and all(subscription.get_publisher_count() for subscription in self._subscriptions)
            ),
            timeout,
        )
        if not found:
            raise TimeoutError(f"no localizer on {', '.join(self.publishers)} within {timeout:g} s")
        # It may take a moment longer to find us, and would miss the first camera info: that is sent with best effort.
        time.sleep(_SETTLING)

    def ask(self, cdr: bytes, timeout: float) -> Answer:
        """Publish a serialized photo and wait for what the localizer says to it."""
        stamp = stamp_text(deserialize_message(cdr, Image).header.stamp)
        time.sleep(_HEAD_START)
        start = time.monotonic()
        self.publishers[self._topics.image].publish(cdr)
        answered = self._spin_until(lambda: self._is_answered(stamp), timeout)
        milliseconds = 1e3 * (time.monotonic() - start) if answered else float("nan")
        return Answer(stamp, self._poses.get(stamp), self._evidence.get(stamp, {}), milliseconds)

    def _is_answered(self, stamp: str) -> bool:
        said = self._evidence.get(stamp)
        return said is not None and (said["status"] != "localized" or stamp in self._poses)

    def _spin_until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Take messages until the condition holds; False when it does not within the timeout."""
        deadline = time.monotonic() + timeout
        while not condition():
            if not self._is_running():
                raise RuntimeError("the localizer has ended")
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=0.1)
        return True

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        position, orientation = message.pose.pose.position, message.pose.pose.orientation
        rotation = matrix_from_quaternion([orientation.x, orientation.y, orientation.z, orientation.w])
        self._poses[stamp_text(message.header.stamp)] = make_pose(rotation, [position.x, position.y, position.z])

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            if "localizer" in status.name and "stamp" in values:
                self._evidence[values["stamp"]] = values
