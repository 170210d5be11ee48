"""The installed localizer in a process of its own, and a client that talks to it over DDS."""

from __future__ import annotations

import itertools
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rclpy
from ament_index_python.packages import get_package_prefix, get_package_share_directory
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import (
    make_pose,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_error_deg,
    translation_error,
)
from gsfeatloc_ros.simulate import SimulatedPhoto

# Seconds. Generous: the first start on a machine compiles kernels, and CI machines are slow and shared.
START_TIMEOUT = 180.0
TIMEOUT = 60.0
# How long to listen before saying that nothing was published.
SILENCE = 1.0
# Best effort may lose an image: it is sent again after this.
RESEND_PERIOD = 3.0

_SECONDS = itertools.count(1000)


def executable() -> Path:
    """The file that `ros2 run gsfeatloc_ros localizer` runs."""
    return Path(get_package_prefix("gsfeatloc_ros")) / "lib" / "gsfeatloc_ros" / "localizer"


class NodeProcess:
    """A running localizer executable with all that it prints.

    Args:
        arguments: its command line, e.g. ("--ros-args", "-p", "map.path:=room.ply").
    """

    def __init__(self, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [executable(), *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self._lines: list[str] = []
        self._printed = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def output(self) -> str:
        """All that it printed up to now."""
        with self._printed:
            return "".join(self._lines)

    def wait_for_output(self, pattern: str, timeout: float = TIMEOUT) -> None:
        """Wait until the output matches a regular expression."""
        with self._printed:
            found = self._printed.wait_for(lambda: re.search(pattern, "".join(self._lines)), timeout)
        assert found, f"no {pattern!r} in {timeout:g} s in the output:\n{self.output}"

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        return self._process.pid

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def wait(self, timeout: float = TIMEOUT) -> int:
        """Exit status, once it has ended by itself."""
        status = self._process.wait(timeout)
        self._reader.join(timeout)
        return status

    def end(self) -> None:
        """Make sure that it is gone; if it still ran, that it left in order."""
        ran = self.alive
        self._process.terminate()
        try:
            self.wait()
        except subprocess.TimeoutExpired:
            self._process.kill()
            self.wait()
        self._process.stdout.close()
        # Until Python has started there is nobody who could handle the signal.
        assert not ran or self._process.returncode in (0, -signal.SIGTERM), self.output

    def _read(self) -> None:
        for line in self._process.stdout:
            with self._printed:
                self._lines.append(line)
                self._printed.notify_all()


def node_arguments(**parameters: object) -> list[str]:
    """Command line with the package's YAML and then `parameters`; `__` in a name stands for the dot."""
    defaults = Path(get_package_share_directory("gsfeatloc_ros")) / "config" / "localizer.yaml"
    arguments = ["--ros-args", "--params-file", str(defaults)]
    for name, value in parameters.items():
        arguments += ["-p", f"{name.replace('__', '.')}:={value}"]
    return arguments


@contextmanager
def running_localizer(**parameters: object) -> Iterator[NodeProcess]:
    """A localizer that is ready."""
    process = NodeProcess(*node_arguments(**parameters))
    try:
        process.wait_for_output(r"\[localizer\]: ready", START_TIMEOUT)
        yield process
    finally:
        process.end()


def assert_start_fails(says: str, **parameters: object) -> None:
    """With these parameters the localizer ends with status 1 and one fatal line that says so."""
    process = NodeProcess(*node_arguments(**parameters))
    try:
        assert process.wait(TIMEOUT) == 1
        lines = process.output.strip().splitlines()
        assert len(lines) == 1, process.output
        assert says in lines[0]
        assert "[FATAL]" in lines[0]
    finally:
        process.end()


@dataclass(frozen=True)
class Diagnostic:
    """One status of the localizer."""

    level: bytes
    reason: str
    values: dict[str, str]

    @property
    def ok(self) -> bool:
        return self.level == DiagnosticStatus.OK


class SpunNode:
    """A node in a context of its own, whose messages are taken while somebody waits for something."""

    def __init__(self, name: str) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def spin_until(self, condition: Callable[[], bool], timeout: float = TIMEOUT) -> bool:
        """Take messages until the condition holds; False when it does not within the timeout."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def spin(self, seconds: float) -> None:
        self.spin_until(lambda: False, seconds)


class Client(SpunNode):
    """A camera and a robot's state estimator, as the localizer sees them, that remember what it published."""

    def __init__(self, name: str = "client", transport: str = "raw") -> None:
        super().__init__(name)
        self.poses: dict[str, PoseWithCovarianceStamped] = {}
        self.renders: list[Image] = []
        self.diagnostics: list[Diagnostic] = []
        # What the localizer said of its health, and of its map.
        self.health: list[Diagnostic] = []
        self.maps: list[Diagnostic] = []
        self._publishers: dict[str, rclpy.publisher.Publisher] = {}
        image = (Image, "image") if transport == "raw" else (CompressedImage, "image/compressed")
        self._image = self.node.create_publisher(*image, 5)
        self._camera_info = self.node.create_publisher(CameraInfo, "camera_info", 5)
        self._prior = self.node.create_publisher(PoseStamped, "prior", 5)
        self._prior_with_covariance = self.node.create_publisher(PoseWithCovarianceStamped, "prior_with_covariance", 5)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(PoseWithCovarianceStamped, "pose", self._on_pose, latched)
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
        return self._publishers[topic]

    def publish(self, topic: str, message: object) -> None:
        """Publish on a topic that the localizer listens to."""
        self.publisher(topic, type(message)).publish(message)
        self.spin(0.2)

    def call(self, service_type: type, name: str, request: object, timeout: float = TIMEOUT) -> object:
        """What a service answers."""
        client = self.node.create_client(service_type, name)
        try:
            assert self.spin_until(client.service_is_ready), f"there is no service {name}"
            future = client.call_async(request)
            assert self.spin_until(future.done, timeout), f"no answer from {name}"
            return future.result()
        finally:
            self.node.destroy_client(client)

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
        return self.spin_until(lambda: any(d.values.get("stamp") == text(image) for d in self.diagnostics), timeout)

    def attempt(self, message: Image | CompressedImage) -> Diagnostic:
        """Send an image until the localizer has said something on it, and return that."""
        message.header.stamp = self.next_stamp()
        return self.until_diagnosed(lambda: self.send_image(message), lambda d: d.values.get("stamp") == text(message))

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
        self.spin_until(lambda: text(message) in self.poses, SILENCE)
        return self.poses.get(text(message))

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
        self.poses[text(message)] = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            said = {
                "localizer: localization": self.diagnostics,
                "localizer: health": self.health,
                "localizer: map": self.maps,
            }
            if status.name in said:
                said[status.name].append(Diagnostic(status.level, status.message, values))


@contextmanager
def connected_client(transport: str = "raw") -> Iterator[Client]:
    """A client that has found the localizer."""
    client = Client(transport=transport)
    try:
        client.connect()
        yield client
    finally:
        client.close()


def text(message: Image | PoseWithCovarianceStamped) -> str:
    """The stamp of a message as in the diagnostics."""
    stamp = message.header.stamp
    return f"{stamp.sec}.{stamp.nanosec:09d}"


def rgb_image(rgb: np.ndarray) -> Image:
    height, width = rgb.shape[:2]
    header = Header(frame_id="camera_optical")
    return Image(header=header, height=height, width=width, encoding="rgb8", step=3 * width, data=rgb.tobytes())


def compressed_image(rgb: np.ndarray, extension: str) -> CompressedImage:
    encoded = cv2.imencode(f".{extension}", rgb[:, :, ::-1])[1]
    return CompressedImage(header=Header(frame_id="camera_optical"), format=extension, data=encoded.tobytes())


def info_of(camera: Camera) -> CameraInfo:
    return CameraInfo(
        width=camera.width,
        height=camera.height,
        k=camera.K.ravel().tolist(),
        d=camera.distortion.tolist(),
        distortion_model=camera.model,
    )


def prior_of(T_map_camera: np.ndarray, frame_id: str = "map") -> PoseStamped:
    message = PoseStamped(header=Header(frame_id=frame_id))
    pose = message.pose
    pose.position.x, pose.position.y, pose.position.z = T_map_camera[:3, 3].tolist()
    quaternion = quaternion_from_matrix(T_map_camera[:3, :3]).tolist()
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = quaternion
    return message


def matrix_of(message: PoseWithCovarianceStamped) -> np.ndarray:
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    rotation = matrix_from_quaternion([orientation.x, orientation.y, orientation.z, orientation.w])
    return make_pose(rotation, [position.x, position.y, position.z])


def assert_close(message: PoseWithCovarianceStamped, T_map_camera: np.ndarray) -> None:
    """Within 1 degree and 2 cm of the truth."""
    pose = matrix_of(message)
    assert rotation_error_deg(pose, T_map_camera) < 1.0
    assert translation_error(pose, T_map_camera) < 0.02


def send_inputs(client: Client, camera: Camera, photo: SimulatedPhoto) -> None:
    """The camera_info and the prior with which a photo can be answered."""
    client.send_camera_info(info_of(camera))
    client.send_prior(prior_of(photo.T_map_camera_prior))


def stamped(message: object, seconds: int) -> object:
    """The message, with this stamp."""
    message.header.stamp = Time(sec=seconds)
    return message


def attempt_at(client: Client, image: Image, seconds: int | None) -> Diagnostic:
    """Send an image, of this stamp or of a new one, until the localizer has said something on it."""
    if seconds is None:
        return client.attempt(image)
    stamped(image, seconds)
    return client.until_diagnosed(lambda: client.send_image(image), lambda d: d.values.get("stamp") == text(image))


def assert_answer(client: Client, photo: SimulatedPhoto, seconds: int | None = None) -> None:
    """The photo, with this stamp or a new one, is answered rightly."""
    image = rgb_image(photo.image)
    diagnostic = attempt_at(client, image, seconds)
    assert diagnostic.ok, diagnostic
    assert_close(client.pose_of(image), photo.T_map_camera)


def assert_no_answer(client: Client, photo: SimulatedPhoto, says: str, seconds: int | None = None) -> None:
    """The photo, with this stamp or a new one, gets no pose, for a reason that matches."""
    image = rgb_image(photo.image)
    diagnostic = attempt_at(client, image, seconds)
    assert not diagnostic.ok
    assert re.search(says, diagnostic.reason), diagnostic
    assert client.pose_of(image) is None
