"""What comes in: the newest message of each topic is kept, and an image offered when it is due."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from gsfeatloc_ros.node.attempts import Job
from gsfeatloc_ros.node.qos import NEWEST, ODOMETRY, RELIABLE, Listener, Topic, subscribe
from gsfeatloc_ros.node.report import Report
from gsfeatloc_ros.ros_io.decode import nanoseconds
from gsfeatloc_ros.ros_io.inputs import Inputs, InputTopic
from gsfeatloc_ros.ros_io.raw_image import validate_image
from gsfeatloc_ros.ros_io.schedule import Schedule
from gsfeatloc_ros.ros_io.settings import COMPRESSED, Settings

_TOPICS = (
    (Topic(CameraInfo, "camera_info", NEWEST, latched=True, needed=True), InputTopic.CAMERA_INFO),
    (Topic(PoseStamped, "prior", RELIABLE, latched=True), InputTopic.PRIOR),
    (Topic(PoseWithCovarianceStamped, "prior_with_covariance", RELIABLE, latched=True), InputTopic.PRIOR),
    (Topic(Odometry, "prior_odometry", RELIABLE, latched=True), InputTopic.PRIOR),
    (Topic(PoseWithCovarianceStamped, "initialpose", RELIABLE, latched=True), InputTopic.INITIAL_POSE),
)
_ODOMETRY_TOPIC = (Topic(Odometry, "odom", ODOMETRY), InputTopic.ODOMETRY)


class Reception:
    """Listens to the node's topics; all of it runs in the executor's thread.

    Callbacks only check and keep the newest message of each topic: an image here, the others in the inputs.

    Args:
        node: whose topics they are.
        settings: of the node.
        inputs: that take all but the images.
        report: of what cannot be used.
        offer: is given an image that is due.
    """

    def __init__(
        self, node: Node, settings: Settings, inputs: Inputs, report: Report, offer: Callable[[Job], None]
    ) -> None:
        self._node, self._settings, self._inputs, self._report, self._offer = node, settings, inputs, report, offer
        compressed = settings.image.transport == COMPRESSED
        image_type = CompressedImage if compressed else Image
        # As image_transport does: a remapping of image holds for the compressed ones as well.
        name = node.resolve_topic_name("image").removesuffix("/compressed") + "/compressed" if compressed else "image"
        self._image_topic = Topic(image_type, name, NEWEST, needed=True)
        resolved = node.resolve_topic_name(name)
        self.no_image = f"no image yet: publish sensor_msgs/{image_type.__name__} on {resolved}"
        # The newest image, or why it cannot be used.
        self._job: Job | str = self.no_image
        self._schedule = Schedule(settings.node)
        self._listeners: list[Listener] = []
        # Names of the topics on which something came.
        self._heard: set[str] = set()

    @property
    def topics(self) -> list[str]:
        """Names of the topics that are listened to, remapped."""
        return [listener.name for listener in self._listeners]

    @property
    def unheard(self) -> list[Listener]:
        """The topics on which nothing came yet."""
        return [listener for listener in self._listeners if listener.topic.name not in self._heard]

    def listen(self) -> None:
        """Subscribe to all topics."""
        self._subscribe(self._image_topic, self._on_image)
        topics = (*_TOPICS, _ODOMETRY_TOPIC) if self._settings.node.track else _TOPICS
        for topic, kind in topics:
            self._subscribe(topic, partial(self._on_input, kind))

    def stop_listening(self) -> None:
        """Unsubscribe, and forget the newest image."""
        for listener in self._listeners:
            for subscription in listener.subscriptions:
                self._node.destroy_subscription(subscription)
        self._listeners = []
        self._heard.clear()
        self._job = self.no_image

    def use_settings(self, settings: Settings) -> None:
        """Go on with other settings, as far as they can change."""
        self._settings = settings
        self._schedule.settings = settings.node

    def newest(self) -> Job:
        """Return the newest image as a job, with the camera_info and the prior of now.

        Raises:
            ValueError: it cannot be localized; all that is missing is named.
        """
        problems, job, silence = self._inputs.missing, self._job, self._report.health.silence
        if isinstance(job, str):
            raise ValueError("; ".join([job, *problems]))
        if silence > self._settings.image.timeout:
            problems.insert(0, f"the newest image came {silence:.1f} s ago: is the camera running?")
        if problems:
            raise ValueError("; ".join(problems))
        return replace(job, inputs=self._inputs.newest())

    def _subscribe(self, topic: Topic, callback: Callable[[Any], None]) -> None:
        refuse = partial(self._report.refuse, f"qos of {topic.name}")

        def take(message: Any) -> None:
            self._heard.add(topic.name)
            callback(message)

        self._listeners.append(subscribe(self._node, topic, take, refuse))

    def _on_image(self, message: Image | CompressedImage) -> None:
        self._report.count_image()
        try:
            if isinstance(message, Image):
                validate_image(message)
        except ValueError as error:
            self._job = str(error)
            self._report.refuse("image", str(error), message.header.stamp)
            return
        self._job = Job(message)
        if self._schedule.is_due(nanoseconds(message.header.stamp) or self._node.get_clock().now().nanoseconds):
            self._offer(self._job)

    def _on_input(self, topic: InputTopic, message: Any) -> None:
        taken = True
        try:
            self._inputs.take(topic, message)
        except ValueError as error:
            taken = False
            self._report.refuse(topic.value, str(error), message.header.stamp)
        if topic in (InputTopic.PRIOR, InputTopic.INITIAL_POSE):
            self._schedule.take_prior(taken)
