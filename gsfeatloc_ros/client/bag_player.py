"""Play a recorded bag into a running localizer, photo by photo, and collect its replies."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Empty

from gsfeatloc_ros.client.client_node import ClientNode
from gsfeatloc_ros.client.messages import pose_matrix, read_diagnostics, stamp_of
from gsfeatloc_ros.client.process import START_TIMEOUT
from gsfeatloc_ros.node.qos import LATCHED, Topic

# Seconds from a photo's prior and camera info to the photo itself: topics have no order, and it must not overtake them.
# (To wait for their acknowledgment would take seconds: it comes with Fast DDS's heartbeat.)
_HEAD_START = 0.1
# Seconds that the localizer may need to find the player after the player has found it.
_SETTLING = 0.5


@dataclass(frozen=True)
class Topics:
    """Names of the topics in the bag, to which the localizer listens too; others with their types, such as tf."""

    image: str
    camera_info: str
    prior: str
    others: tuple[Topic, ...] = ()

    @property
    def remappings(self) -> dict[str, str]:
        """The localizer's names of the topics, and what they are called in the bag."""
        return {"image": self.image, "camera_info": self.camera_info, "prior": self.prior}


@dataclass(frozen=True, eq=False)
class Reply:
    """What the localizer said to one photo.

    Attributes:
        stamp: of the photo, seconds with nine decimals.
        T_map_camera: (4, 4) pose that was published; None when there was none.
        evidence: the values of the localizer's diagnostic by key (status, reason, inliers ...); empty without a reply.
        milliseconds: wall time from sending the photo until the reply had come; NaN without one.
    """

    stamp: str
    T_map_camera: np.ndarray | None
    evidence: dict[str, str]
    milliseconds: float


def play_bag(
    path: str | Path,
    topics: Topics,
    is_running: Callable[[], bool],
    start_timeout: float = START_TIMEOUT,
    reply_timeout: float = 30.0,
) -> Iterator[Reply]:
    """Publish every photo of a bag, after its camera info and prior, and yield the localizer's reply to it.

    The next photo is sent when the reply is there, or after `reply_timeout` seconds without one.

    Args:
        path: rosbag2 folder.
        topics: which topics to play.
        is_running: whether the localizer still runs; asked while waiting for it.
        start_timeout: seconds that the localizer may take to appear; it compiles its kernels at the first start.
        reply_timeout: seconds that it may take to reply.

    Raises:
        RuntimeError: the localizer ended.
        TimeoutError: the localizer did not appear on its topics.
    """
    player = _Player(topics, is_running)
    try:
        player.wait_for_localizer(start_timeout)
        with Reader(path) as bag:
            played = [connection for connection in bag.connections if connection.topic in player.publishers]
            for connection, _, cdr in bag.messages(played):
                if connection.topic == topics.image:
                    yield player.localize(bytes(cdr), reply_timeout)
                else:
                    player.publishers[connection.topic].publish(bytes(cdr))
    finally:
        player.close()


def play_lost(
    path: str | Path,
    topics: Topics,
    photos: Collection[int],
    is_running: Callable[[], bool],
    reply_timeout: float = 30.0,
) -> Iterator[Reply]:
    """Publish some photos of a bag without priors, to a localizer that is told before each that it is lost.

    Args:
        photos: numbers of the photos in the bag, from 0 on.
        path, topics, is_running, reply_timeout: as for play_bag.

    Raises:
        RuntimeError: the localizer ended.
        TimeoutError: the localizer did not appear on its topics, or did not hear that it is lost.
    """
    player = _Player(topics, is_running)
    try:
        player.wait_for_localizer(START_TIMEOUT)
        with Reader(path) as bag:
            played = [c for c in bag.connections if c.topic in (topics.image, topics.camera_info)]
            number = -1
            for connection, _, cdr in bag.messages(played):
                number += connection.topic == topics.image
                if connection.topic == topics.camera_info:
                    player.publishers[connection.topic].publish(bytes(cdr))
                elif number in photos:
                    player.lose(reply_timeout)
                    yield player.localize(bytes(cdr), reply_timeout)
    finally:
        player.close()


class _Player(ClientNode):
    """A node that publishes the topics of a bag and remembers what the localizer says."""

    def __init__(self, topics: Topics, is_running: Callable[[], bool]) -> None:
        super().__init__("bag_player")
        self._topics, self._is_running = topics, is_running
        self._poses: dict[str, np.ndarray] = {}
        self._evidence: dict[str, dict[str, str]] = {}
        types = {topics.image: Image, topics.camera_info: CameraInfo, topics.prior: PoseStamped}
        self.publishers = {topic: self.node.create_publisher(kind, topic, 10) for topic, kind in types.items()}
        for other in topics.others:
            self.publishers[other.name] = self.node.create_publisher(other.message_type, other.name, other.qos)
        self._lose = self.node.create_client(Empty, "reinitialize_global_localization")
        self._subscriptions = (
            self.node.create_subscription(PoseWithCovarianceStamped, "pose", self._on_pose, LATCHED),
            self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100),
        )

    def wait_for_localizer(self, timeout: float) -> None:
        """Wait until the localizer listens to all topics and is heard on its own."""
        found = self._wait_until(
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

    def lose(self, timeout: float) -> None:
        """Tell the localizer that it is lost."""
        lost = (
            self._lose.call_async(Empty.Request()) if self._wait_until(self._lose.service_is_ready, timeout) else None
        )
        if lost is None or not self._wait_until(lost.done, timeout):
            raise TimeoutError(f"no answer from {self._lose.srv_name} within {timeout:g} s")

    def localize(self, cdr: bytes, timeout: float) -> Reply:
        """Publish a serialized photo and wait for what the localizer says to it."""
        stamp = stamp_of(deserialize_message(cdr, Image))
        time.sleep(_HEAD_START)
        start = time.monotonic()
        self.publishers[self._topics.image].publish(cdr)
        replied = self._wait_until(lambda: self._has_reply(stamp), timeout)
        milliseconds = 1e3 * (time.monotonic() - start) if replied else float("nan")
        return Reply(stamp, self._poses.get(stamp), self._evidence.get(stamp, {}), milliseconds)

    def _has_reply(self, stamp: str) -> bool:
        evidence = self._evidence.get(stamp)
        return evidence is not None and (evidence["status"] != "localized" or stamp in self._poses)

    def _wait_until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Take messages until the condition holds; return False when it does not within `timeout` seconds.

        Raises:
            RuntimeError: the localizer ended.
        """
        found = self.spin_until(lambda: condition() or not self._is_running(), timeout)
        if found and not condition():
            raise RuntimeError("the localizer has ended")
        return found

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._poses[stamp_of(message)] = pose_matrix(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for diagnostic in read_diagnostics(message):
            if "localizer" in diagnostic.name and "stamp" in diagnostic.values:
                self._evidence[diagnostic.values["stamp"]] = diagnostic.values
