"""The installed localizer, and a client that talks to it over DDS and checks what it says."""

from __future__ import annotations

import itertools
import re
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import cv2
import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from gsfeatloc_ros.client import process
from gsfeatloc_ros.client.client_node import TIMEOUT, ClientNode
from gsfeatloc_ros.client.messages import (
    CAMERA_FRAME,
    Diagnostic,
    camera_info_of,
    pose_matrix,
    pose_stamped,
    read_diagnostics,
    rgb_image,
    stamp_of,
)
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import rotation_error_deg, translation_error
from gsfeatloc_ros.node.qos import LATCHED
from gsfeatloc_ros.simulate import SimulatedPhoto

# How long to listen before saying that nothing was published.
SILENCE = 1.0
# An answer comes within this, if the localizer knows whom to send it to.
ANSWER_PERIOD = 0.5
# Best effort may lose an image: it is sent again after this.
RESEND_PERIOD = 3.0

_SECONDS = itertools.count(1000)


class NodeProcess(process.LocalizerProcess):
    """A started localizer, which has to leave in order.

    Args:
        arguments: its command line, as of node_arguments().
        environment: changes of this process's; None takes a variable out.
    """

    def __init__(self, *arguments: str, environment: Mapping[str, str | None] | None = None) -> None:
        super().__init__(arguments, environment=environment)

    def wait_for_output(self, pattern: str, timeout: float = TIMEOUT) -> None:
        super().wait_for_output(pattern, timeout)

    def wait_for_index(self) -> None:
        """Wait until it finds images without a prior; index.build is true."""
        super().wait_for_output(process.INDEX_READY, process.START_TIMEOUT)

    def wait(self, timeout: float = TIMEOUT) -> int:
        return super().wait(timeout)

    def end(self) -> None:
        """Make sure that it is gone; if it still ran, that it left in order."""
        ran = self.alive
        status = self.stop(signal.SIGTERM, TIMEOUT)
        output = self.output
        self.close()
        # Until Python has started there is nobody who could handle the signal.
        assert not ran or status in (0, -signal.SIGTERM), output


def node_arguments(**parameters: object) -> list[str]:
    """Return the command line that sets `parameters`; `__` in a name stands for the dot."""
    given = {name.replace("__", "."): value for name, value in parameters.items()}
    # Who needs the index of views asks for it: to make it takes seven times as long as all else of a start. So few
    # views are enough for a room.
    return process.node_arguments({"index.build": False, "index.views": 60} | given)


@contextmanager
def running_localizer(**parameters: object) -> Iterator[NodeProcess]:
    """A localizer that is ready."""
    localizer = NodeProcess(*node_arguments(**parameters))
    try:
        localizer.wait_until_ready()
        yield localizer
    finally:
        localizer.end()


def assert_start_fails(says: str, environment: Mapping[str, str | None] | None = None, **parameters: object) -> None:
    """With these parameters the localizer ends with status 1 and one fatal line that says so."""
    localizer = NodeProcess(*node_arguments(**parameters), environment=environment)
    try:
        assert localizer.wait() == 1
        lines = localizer.output.strip().splitlines()
        assert len(lines) == 1, localizer.output
        assert says in lines[0]
        assert "[FATAL]" in lines[0]
    finally:
        localizer.end()


def settle(client: ClientNode, node: str = "localizer") -> None:
    """Wait until a node has found all that the client made until now: what is sent to it before that is lost.

    A participant tells of its endpoints in the order in which they were made. That a service answers to one made only
    now shows that those made before are known as well; asking again and again for nothing does no harm.
    """
    service = client.node.create_client(GetParameters, f"{node}/get_parameters")
    try:
        assert client.spin_until(service.service_is_ready), f"there is no node {node}"
        for _ in range(int(TIMEOUT / ANSWER_PERIOD)):
            if client.spin_until(service.call_async(GetParameters.Request()).done, ANSWER_PERIOD):
                return
        raise AssertionError(f"{node} does not answer")
    finally:
        client.node.destroy_client(service)


class Client(ClientNode):
    """A camera and a robot's state estimator, as the localizer sees them, that remember what it published."""

    def __init__(self, name: str = "client", transport: str = "raw") -> None:
        super().__init__(name)
        self.poses: dict[str, PoseWithCovarianceStamped] = {}
        self.renders: list[Image] = []
        self.diagnostics: list[Diagnostic] = []
        # What the localizer said of its health, and of its map.
        self.health: list[Diagnostic] = []
        self.maps: list[Diagnostic] = []
        # And of the state, and the view index.
        self.states: list[Diagnostic] = []
        self.index: list[Diagnostic] = []
        self._publishers: dict[str, rclpy.publisher.Publisher] = {}
        self._services: dict[str, rclpy.client.Client] = {}
        image = (Image, "image") if transport == "raw" else (CompressedImage, "image/compressed")
        self._image = self.node.create_publisher(*image, 5)
        self._camera_info = self.node.create_publisher(CameraInfo, "camera_info", 5)
        self._prior = self.node.create_publisher(PoseStamped, "prior", 5)
        self._prior_with_covariance = self.node.create_publisher(PoseWithCovarianceStamped, "prior_with_covariance", 5)
        self.node.create_subscription(PoseWithCovarianceStamped, "pose", self._on_pose, LATCHED)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._relocalize = self.node.create_client(Trigger, "localizer/relocalize")

    def connect(self) -> None:
        """Wait until the localizer and this client have found each other."""
        publishers = (self._image, self._camera_info, self._prior, self._prior_with_covariance)
        found = self.spin_until(
            lambda: (
                all(publisher.get_subscription_count() == 1 for publisher in publishers)
                and self.node.count_publishers("pose") == 1
                and self.node.count_publishers("/diagnostics") == 1
                and self._relocalize.service_is_ready()
            )
        )
        assert found, "the localizer was not discovered"
        settle(self)

    def listen_to_renders(self) -> None:
        self.node.create_subscription(Image, "rendered_image", self.renders.append, 5)

    def listen(self, message_type: type, topic: str) -> list:
        """The messages that come on a topic from now on, as they come."""
        messages: list = []
        self.node.create_subscription(message_type, topic, messages.append, 10)
        return messages

    def publisher(self, topic: str, message_type: type) -> rclpy.publisher.Publisher:
        """A publisher on a topic that the localizer listens to."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(message_type, topic, 10)
            heard = self.spin_until(lambda: self._publishers[topic].get_subscription_count() > 0)
            assert heard, f"nobody listens to {topic}"
            settle(self)
        return self._publishers[topic]

    def publish(self, topic: str, message: object) -> None:
        """Publish on a topic that the localizer listens to."""
        self.publisher(topic, type(message)).publish(message)
        self.spin(0.2)

    def call(self, service_type: type, name: str, request: object, timeout: float = TIMEOUT) -> object:
        """What a service of a node answers; its name is that of the node, a slash, and its own."""
        if name not in self._services:
            self._services[name] = self.node.create_client(service_type, name)
            assert self.spin_until(self._services[name].service_is_ready), f"there is no service {name}"
            settle(self, name.rpartition("/")[0] or "localizer")
        assert self.spin_until(self._services[name].service_is_ready), f"there is no service {name} any more"
        future = self._services[name].call_async(request)
        assert self.spin_until(future.done, timeout), f"no answer from {name}"
        return future.result()

    def set_parameter(self, name: str, value: object) -> SetParametersResult:
        """Set a parameter of the localizer while it runs."""
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.call(SetParameters, "localizer/set_parameters", request).results[0]

    def parameter(self, name: str) -> object:
        """The value of a parameter of the localizer."""
        answer = self.call(GetParameters, "localizer/get_parameters", GetParameters.Request(names=[name]))
        return parameter_value_to_python(answer.values[0])

    def next_stamp(self) -> Time:
        """A stamp that no client used before."""
        return Time(sec=next(_SECONDS), nanosec=123456789)

    def send_camera_info(self, message: CameraInfo) -> None:
        self._camera_info.publish(message)
        # There is no order between topics: what is sent next must not overtake it.
        self.spin(0.2)

    def send_prior(self, message: PoseStamped | PoseWithCovarianceStamped) -> None:
        publisher = self._prior if isinstance(message, PoseStamped) else self._prior_with_covariance
        publisher.publish(message)
        self.spin(0.2)

    def send_image(self, message: Image | CompressedImage) -> None:
        self._image.publish(message)

    def send_once(self, rgb: np.ndarray) -> Image:
        """Send an image of pixels (H, W, 3) with a new stamp, and say what was sent."""
        image = rgb_image(rgb)
        image.header.stamp = self.next_stamp()
        self.send_image(image)
        return image

    def is_tried(self, image: Image, timeout: float = 3.0) -> bool:
        """Whether the localizer says something on an image before the timeout."""
        return self.spin_until(lambda: any(d.values.get("stamp") == stamp_of(image) for d in self.diagnostics), timeout)

    def attempt(self, message: Image | CompressedImage) -> Diagnostic:
        """Send an image until the localizer has said something on it, and return that."""
        message.header.stamp = self.next_stamp()
        return self.attempt_as_stamped(message)

    def attempt_as_stamped(self, message: Image | CompressedImage) -> Diagnostic:
        """Send an image with the stamp that it has until the localizer has said something on it, and return that."""
        stamp = stamp_of(message)
        return self.until_diagnosed(lambda: self.send_image(message), lambda d: d.values.get("stamp") == stamp)

    def until_diagnosed(self, send: Callable[[], None], wanted: Callable[[Diagnostic], bool]) -> Diagnostic:
        """Send until there is a new diagnostic that is wanted, and return it."""
        seen = len(self.diagnostics)
        for _ in range(int(TIMEOUT / RESEND_PERIOD)):
            send()
            if self.spin_until(lambda: any(map(wanted, self.diagnostics[seen:])), RESEND_PERIOD):
                return next(filter(wanted, self.diagnostics[seen:]))
        raise AssertionError(f"no diagnostic as wanted among {self.diagnostics[seen:]}")

    def until_refused(self, send: Callable[[], None], says: str) -> Diagnostic:
        """Send until the localizer has refused it with a reason that matches a regular expression."""
        return self.until_diagnosed(send, lambda d: d.values["status"] == "refused" and re.search(says, d.reason))

    def pose_of(self, message: Image) -> PoseWithCovarianceStamped | None:
        """The pose published for an image, None if there was none within a short while."""
        self.spin_until(lambda: stamp_of(message) in self.poses, SILENCE)
        return self.poses.get(stamp_of(message))

    def relocalize(self, timeout: float = TIMEOUT) -> Trigger.Response:
        return self.relocalize_together(1, timeout)[0]

    def send_request(self) -> rclpy.Future:
        """Ask to relocalize; the answer comes while spinning."""
        return self._relocalize.call_async(Trigger.Request())

    def relocalize_together(self, count: int, timeout: float = TIMEOUT) -> list[Trigger.Response]:
        """Send `count` requests at once and wait for all the answers."""
        futures = [self.send_request() for _ in range(count)]
        assert self.spin_until(lambda: all(future.done() for future in futures), timeout), "no answer"
        return [future.result() for future in futures]

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self.poses[stamp_of(message)] = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        lists = {
            "localization": self.diagnostics,
            "health": self.health,
            "map": self.maps,
            "state": self.states,
            "index": self.index,
        }
        for diagnostic in read_diagnostics(message):
            if diagnostic.name == f"localizer: {diagnostic.part}":
                lists[diagnostic.part].append(diagnostic)


@contextmanager
def connected_client(transport: str = "raw") -> Iterator[Client]:
    """A client that has found the localizer."""
    client = Client(transport=transport)
    try:
        client.connect()
        yield client
    finally:
        client.close()


def compressed_image(rgb: np.ndarray, extension: str) -> CompressedImage:
    """Return pixels (H, W, 3) uint8 RGB as an image of a format such as png."""
    encoded = cv2.imencode(f".{extension}", rgb[:, :, ::-1])[1]
    return CompressedImage(header=Header(frame_id=CAMERA_FRAME), format=extension, data=encoded.tobytes())


def odometry(T_odom_body: np.ndarray, stamp: Time, child: str) -> Odometry:
    """Return the pose (4, 4) of a body in the odometry's frame as a message."""
    message = Odometry(header=Header(stamp=stamp, frame_id="odom"), child_frame_id=child)
    message.pose.pose = pose_stamped(T_odom_body).pose
    return message


def stamped(message: object, seconds: int) -> object:
    """The message, with this stamp."""
    message.header.stamp = Time(sec=seconds)
    return message


def send_inputs(client: Client, camera: Camera, photo: SimulatedPhoto) -> None:
    """Send the camera_info and the prior with which a photo can be answered."""
    client.send_camera_info(camera_info_of(camera))
    client.send_prior(pose_stamped(photo.T_map_camera_prior))


def attempt_at(client: Client, image: Image, seconds: int | None) -> Diagnostic:
    """Send an image, of this stamp or of a new one, until the localizer has said something on it."""
    return client.attempt(image) if seconds is None else client.attempt_as_stamped(stamped(image, seconds))


def assert_close(message: PoseWithCovarianceStamped, T_map_camera: np.ndarray) -> None:
    """Within 1 degree and 2 cm of the truth."""
    pose = pose_matrix(message)
    assert rotation_error_deg(pose, T_map_camera) < 1.0
    assert translation_error(pose, T_map_camera) < 0.02


def assert_answer(client: Client, photo: SimulatedPhoto, seconds: int | None = None) -> None:
    """The photo, with this stamp or a new one, is answered rightly."""
    image = rgb_image(photo.image)
    diagnostic = attempt_at(client, image, seconds)
    assert diagnostic.ok, diagnostic
    assert_close(client.pose_of(image), photo.T_map_camera)


def assert_no_answer(client: Client, image: Image, says: str, seconds: int | None = None) -> Diagnostic:
    """The image, with this stamp or a new one, gets no pose, for a reason that matches; return the diagnostic."""
    diagnostic = attempt_at(client, image, seconds)
    assert not diagnostic.ok
    assert re.search(says, diagnostic.reason), diagnostic
    assert client.pose_of(image) is None
    return diagnostic
