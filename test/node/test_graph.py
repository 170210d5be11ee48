"""What is said of inputs that do not come, by a graph of publishers in this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from gsfeatloc_ros.node import graph
from gsfeatloc_ros.node.graph import GraphWatch
from gsfeatloc_ros.node.qos import LAST, NEWEST, RELIABLE, Listener, Topic, subscribe
from gsfeatloc_ros.ros_io.settings import CONTINUOUS, ON_PRIOR, ON_REQUEST

IMAGE = Topic(Image, "image", NEWEST, needed=True)
INFO = Topic(CameraInfo, "camera_info", NEWEST, latched=True, needed=True)
PRIORS = (
    Topic(PoseStamped, "prior", RELIABLE, latched=True),
    Topic(PoseWithCovarianceStamped, "prior_with_covariance", RELIABLE, latched=True),
    Topic(Odometry, "prior_odometry", RELIABLE, latched=True),
    Topic(PoseWithCovarianceStamped, "initialpose", RELIABLE, latched=True),
)


class Said:
    """Takes what is to be logged."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def say(self, text: str) -> None:
        self.texts.append(text)


class Graph:
    """A node that listens, another that publishes, and what is found."""

    def __init__(self, node: Node, robot: Node) -> None:
        self.node, self.robot, self.said = node, robot, Said()
        self.heard: list[object] = []
        self.watch = GraphWatch(node, self.said)
        self.executor = SingleThreadedExecutor(context=node.context)
        self.executor.add_node(node)

    def listen(self, topic: Topic) -> Listener:
        return subscribe(self.node, topic, self.heard.append, lambda reason: None)

    def spin_until(self, condition: Callable[[], bool], seconds: float = 10.0) -> bool:
        end = graph.time.monotonic() + seconds
        while not condition() and graph.time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)
        return condition()

    def assert_said(self, expected: str, topic: Topic, mode: str = CONTINUOUS) -> None:
        listener = self.listen(topic)
        said = lambda: self.watch.look([listener], mode)  # noqa: E731
        assert self.spin_until(lambda: expected in said()), said()
        for subscription in listener.subscriptions:
            self.node.destroy_subscription(subscription)


@pytest.fixture(scope="module")
def nodes() -> Iterator[tuple[Node, Node]]:
    # Two participants: one alone has a topic of one type only.
    contexts = [rclpy.Context(), rclpy.Context()]
    for context in contexts:
        rclpy.init(context=context)
    listener = rclpy.create_node("listener", context=contexts[0])
    robot = rclpy.create_node("robot", context=contexts[1])
    yield listener, robot
    listener.destroy_node()
    robot.destroy_node()
    for context in contexts:
        rclpy.shutdown(context=context)


@pytest.fixture
def found(nodes) -> Iterator[Graph]:
    yield Graph(*nodes)
    for publisher in list(nodes[1].publishers):
        if publisher.topic_name not in ("/rosout", "/parameter_events"):
            nodes[1].destroy_publisher(publisher)


def test_nobody_publishes(found):
    found.assert_said("nobody publishes /image (sensor_msgs/msg/Image): start what does, or remap image", IMAGE)


def test_it_is_published_elsewhere(found):
    found.robot.create_publisher(CameraInfo, "camera/camera_info", 1)
    found.assert_said("of this type are /camera/camera_info: remap camera_info", INFO)


@pytest.mark.parametrize(
    ("published", "name", "topic", "expected"),
    [
        (CompressedImage, "image/compressed", IMAGE, "but /image/compressed is: set image.transport:=compressed"),
        (
            CompressedImage,
            "image",
            IMAGE,
            "/image has sensor_msgs/msg/CompressedImage, not sensor_msgs/msg/Image: set image.transport:=compressed, "
            "remap /image/compressed:=/image",
        ),
        (
            Image,
            "image",
            Topic(CompressedImage, "/image/compressed", NEWEST, needed=True),
            "but /image is: set image.transport:=raw",
        ),
        (Odometry, "prior", PRIORS[0], "not geometry_msgs/msg/PoseStamped: remap prior_odometry:=/prior"),
        (PoseWithCovarianceStamped, "prior", PRIORS[0], "remap prior_with_covariance:=/prior"),
        (PoseStamped, "initialpose", PRIORS[3], "remap prior:=/initialpose"),
        (Image, "camera_info", INFO, "/camera_info has sensor_msgs/msg/Image, not sensor_msgs/msg/CameraInfo: publish"),
    ],
)
def test_something_else_is_published(found, published, name, topic, expected):
    found.robot.create_publisher(published, name, 1)
    found.assert_said(expected, topic)


def test_the_quality_of_service_does_not_fit(found):
    found.robot.create_publisher(PoseStamped, "prior", NEWEST)
    found.assert_said("/prior is published with a QoS that does not fit (", PRIORS[0])


def test_a_publisher_is_silent(found):
    found.robot.create_publisher(Image, "image", 1)
    found.assert_said("/image has a publisher, but nothing came from it", IMAGE)


def test_what_is_not_needed_is_not_missed(found):
    listeners = [found.listen(topic) for topic in (IMAGE, INFO, *PRIORS)]
    assert "/prior" not in found.watch.look(listeners, CONTINUOUS)
    assert found.watch.look(listeners, ON_REQUEST) == ""
    said = found.watch.look(listeners[2:], ON_PRIOR)
    assert all(f"/{topic.name} (" in said for topic in PRIORS)
    # One of them is enough.
    assert found.watch.look(listeners[3:], ON_PRIOR) == ""


def test_it_is_logged_once_and_when_it_changes(found, monkeypatch):
    now = graph.time.monotonic()
    monkeypatch.setattr(graph.time, "monotonic", lambda: now)
    listeners = [found.listen(IMAGE), found.listen(INFO)]
    found.watch.begin()
    found.watch.look(listeners, CONTINUOUS)
    assert found.said.texts == []
    now += 6.0
    for _ in range(3):
        found.watch.look(listeners, CONTINUOUS)
    found.watch.look(listeners[:1], CONTINUOUS)
    found.watch.look([], CONTINUOUS)
    assert ["/camera_info" in text for text in found.said.texts] == [True, False, False]
    assert found.said.texts[-1] == "all inputs come now"


def test_what_was_said_before_is_heard_once(found):
    publisher = found.robot.create_publisher(CameraInfo, "camera_info", LAST)
    publisher.publish(CameraInfo(width=1))
    listener = found.listen(INFO)
    assert found.spin_until(lambda: (found.watch.look([listener], CONTINUOUS), len(found.heard) == 1)[1])
    publisher.publish(CameraInfo(width=2))
    assert found.spin_until(lambda: len(found.heard) == 2)
    found.spin_until(lambda: len(found.heard) > 2, seconds=0.5)
    assert [message.width for message in found.heard] == [1, 2]
    # Of one that keeps nothing only what it says now.
    late = found.robot.create_publisher(CameraInfo, "camera_info", NEWEST)

    def heard_late() -> bool:
        late.publish(CameraInfo(width=3))
        return len(found.heard) > 2

    assert found.spin_until(heard_late)
    assert {message.width for message in found.heard[2:]} == {3}
