"""Two installed localizers in one graph, each with its own namespace, map and frame."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from node_harness import RESEND_PERIOD, TIMEOUT, NodeProcess, node_arguments, settle
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger

from gsfeatloc_ros.client.client_node import ClientNode
from gsfeatloc_ros.client.messages import (
    camera_info_of,
    pose_matrix,
    pose_stamped,
    read_diagnostics,
    rgb_image,
    stamp_of,
)
from gsfeatloc_ros.client.process import START_TIMEOUT
from gsfeatloc_ros.common.geometry import quaternion_from_matrix, rotation_error_deg, so3_exp, translation_error
from gsfeatloc_ros.maps import Similarity

# Where the room lies in the frame of each map; that of /b is larger and far away.
ALIGNMENTS = {
    "a": Similarity(),
    "b": Similarity(1.5, so3_exp(np.array([0.0, 0.0, 2.0])), np.array([40.0, -30.0, 5.0])),
}


def localizer(name: str, map_file: Path) -> NodeProcess:
    """A localizer in namespace /`name`, with the room's map in the frame map_`name`."""
    alignment = ALIGNMENTS[name]
    parameters = {
        "map__path": map_file,
        "map__frame_id": f"map_{name}",
        "map__scale": alignment.scale,
        "map__rotation": str(quaternion_from_matrix(alignment.rotation).tolist()),
        "map__translation": str(alignment.translation.tolist()),
        "localizer__prior_translation": 0.5 * alignment.scale,
    }
    return NodeProcess(*node_arguments(**parameters), "-r", f"__ns:=/{name}")


class Robots(ClientNode):
    """The robots of both namespaces, and what the localizers say to them."""

    def __init__(self) -> None:
        super().__init__("robots")
        self.poses: dict[str, dict[str, PoseWithCovarianceStamped]] = {name: {} for name in ALIGNMENTS}
        # By the name of the status: the stamps of images and how they were answered.
        self.statuses: dict[str, dict[str, str]] = {}
        node = self.node
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        types = {"image": Image, "camera_info": CameraInfo, "prior": PoseStamped}
        self._publishers = {
            (name, topic): node.create_publisher(kind, f"/{name}/{topic}", 5)
            for name in ALIGNMENTS
            for topic, kind in types.items()
        }
        self._services = {name: node.create_client(Trigger, f"/{name}/localizer/relocalize") for name in ALIGNMENTS}
        for name in ALIGNMENTS:
            node.create_subscription(
                PoseWithCovarianceStamped,
                f"/{name}/pose",
                lambda message, name=name: self.poses[name].update({stamp_of(message): message}),
                10,
            )

    def connect(self) -> None:
        """Wait until the localizers and this node have found each other."""
        found = self.spin_until(
            lambda: (
                all(publisher.get_subscription_count() for publisher in self._publishers.values())
                and all(service.service_is_ready() for service in self._services.values())
                and all(self.node.count_publishers(f"/{name}/pose") for name in ALIGNMENTS)
                and self.node.count_publishers("/diagnostics") >= len(ALIGNMENTS)
            )
        )
        assert found, "the localizers were not discovered"
        for name in ALIGNMENTS:
            settle(self, f"/{name}/localizer")

    def send(self, name: str, topic: str, message: object) -> None:
        self._publishers[name, topic].publish(message)

    def send_image(self, name: str, image: Image) -> str:
        """Send an image until the localizer has said something on it, and return what: its status."""
        statuses = self.statuses.setdefault(f"{name}/localizer: localization", {})
        deadline = time.monotonic() + TIMEOUT
        while stamp_of(image) not in statuses and time.monotonic() < deadline:
            self.send(name, "image", image)
            # Best effort may lose an image.
            self.spin_until(lambda: stamp_of(image) in statuses, RESEND_PERIOD)
        return statuses[stamp_of(image)]

    def pose(self, name: str, image: Image) -> PoseWithCovarianceStamped:
        """The answer to an image."""
        assert self.spin_until(lambda: stamp_of(image) in self.poses[name]), f"no pose from {name}: {self.statuses}"
        return self.poses[name][stamp_of(image)]

    def relocalize(self, name: str) -> Trigger.Response:
        future = self._services[name].call_async(Trigger.Request())
        assert self.spin_until(future.done), "no answer"
        return future.result()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for diagnostic in read_diagnostics(message):
            values = diagnostic.values
            answers = self.statuses.setdefault(diagnostic.name, {})
            answers[values.get("stamp", "")] = values.get("status", diagnostic.reason)


@pytest.fixture(scope="module")
def localizers(room_map_file):
    # One after the other: the first makes the files of compiled code and of the prepared map that both read.
    processes = {}
    try:
        for name in ALIGNMENTS:
            processes[name] = localizer(name, room_map_file)
            processes[name].wait_for_output(rf"\[{name}\.localizer\]: ready", START_TIMEOUT)
        yield processes
    finally:
        for process in processes.values():
            process.end()


@pytest.fixture
def robots(localizers):
    robots = Robots()
    try:
        robots.connect()
        yield robots
    finally:
        robots.close()


def send_inputs(robots: Robots, name: str, camera, photo) -> None:
    robots.send(name, "camera_info", camera_info_of(camera))
    prior = ALIGNMENTS[name].transform_pose(photo.T_map_camera_prior)
    robots.send(name, "prior", pose_stamped(prior, f"map_{name}"))
    robots.spin(0.3)


def image_of(photo, second: int) -> Image:
    image = rgb_image(photo.image)
    image.header.stamp.sec = second
    return image


def assert_right(pose: PoseWithCovarianceStamped, name: str, photo) -> None:
    alignment = ALIGNMENTS[name]
    truth = alignment.transform_pose(photo.T_map_camera)
    assert pose.header.frame_id == f"map_{name}"
    assert rotation_error_deg(pose_matrix(pose), truth) < 1.0
    assert translation_error(pose_matrix(pose), truth) < 0.02 * alignment.scale


def test_each_answers_its_own_images_from_its_own_map(robots, room_camera, room_photos):
    photos = dict(zip(ALIGNMENTS, room_photos, strict=False))
    images = {name: image_of(photo, 100 + index) for index, (name, photo) in enumerate(photos.items())}
    for name, photo in photos.items():
        send_inputs(robots, name, room_camera, photo)
    for name, image in images.items():
        assert robots.send_image(name, image) == "localized"
    for name, photo in photos.items():
        assert_right(robots.pose(name, images[name]), name, photo)
    # Nobody else said anything on them, and both say how they are.
    robots.spin(2.0)
    # Of the index only while one is built, or once it is ready.
    said = {name for name in robots.statuses if not name.endswith("index")}
    assert said == {f"{name}/localizer: {part}" for name in ALIGNMENTS for part in ("localization", "health", "state")}
    for name, other in ("ab", "ba"):
        assert stamp_of(images[name]) not in robots.poses[other]
        assert stamp_of(images[name]) not in robots.statuses[f"{other}/localizer: localization"]


def test_each_service_is_of_its_own_localizer(robots, room_camera, room_photos):
    photo = room_photos[2]
    send_inputs(robots, "b", room_camera, photo)
    image = image_of(photo, 200)
    assert robots.send_image("b", image) == "localized"
    robots.pose("b", image)
    robots.poses["b"].clear()
    assert robots.relocalize("b").success
    assert_right(robots.pose("b", image), "b", photo)
    assert stamp_of(image) not in robots.poses["a"]


def test_a_prior_in_the_frame_of_the_other_map_is_refused(robots, room_camera, room_photos):
    photo = room_photos[3]
    send_inputs(robots, "a", room_camera, photo)
    robots.send("a", "prior", pose_stamped(photo.T_map_camera_prior, "map_b"))
    robots.spin(0.3)
    assert robots.send_image("a", image_of(photo, 300)) == "refused"
    answer = robots.relocalize("a")
    assert not answer.success
    assert "prior is in frame 'map_b' but the map is in 'map_a'" in answer.message


def test_one_ends_and_the_other_goes_on(robots, localizers, room_camera, room_photos):
    # The last test: those before need both.
    localizers["a"].end()
    photo = room_photos[4]
    send_inputs(robots, "b", room_camera, photo)
    image = image_of(photo, 400)
    assert robots.send_image("b", image) == "localized"
    assert_right(robots.pose("b", image), "b", photo)
