"""The installed localizer of a robot that is lost: found without a prior, followed, found again."""

from __future__ import annotations

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray
from gsfeatloc_interfaces.srv import LocalizeImage
from node_harness import TIMEOUT, Client, assert_close, connected_client, odometry, running_localizer, settle
from std_srvs.srv import Empty

from gsfeatloc_ros.client.messages import (
    Diagnostic,
    camera_info_of,
    pose_stamped,
    pose_with_covariance,
    rgb_image,
    stamp_of,
)
from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp
from gsfeatloc_ros.node.qos import LAST
from gsfeatloc_ros.simulate import SimulatedPhoto

# Seconds in which a robot that was carried off is found again.
RECOVERY = 2.0
COVERED = np.random.default_rng(0).integers(0, 60, (480, 640, 3), dtype=np.uint8)


class Robot:
    """A camera on a robot, with odometry or without."""

    def __init__(self, client: Client, has_odometry: bool) -> None:
        self._client, self._has_odometry = client, has_odometry
        self.states: list[DiagnosticStatus] = []
        client.node.create_subscription(DiagnosticStatus, "localizer/state", self.states.append, LAST)

    def see(self, pixels: np.ndarray, T_odom_camera: np.ndarray | None = None) -> tuple[Diagnostic, str]:
        """What the localizer says of an image, and its stamp; the odometry sees the robot stand still by default."""
        image = rgb_image(pixels)
        image.header.stamp = self._client.next_stamp()
        if self._has_odometry:
            at = np.eye(4) if T_odom_camera is None else T_odom_camera
            self._client.publish("odom", odometry(at, image.header.stamp, "camera_optical"))
        diagnostic = self._client.attempt_as_stamped(image)
        return diagnostic, stamp_of(image)

    def find(self, photo: SimulatedPhoto, attempts: int) -> list[Diagnostic]:
        """Show a photo until its pose is published, which is right, and takes at most so many attempts."""
        said = []
        for _ in range(attempts):
            diagnostic, stamp = self.see(photo.image)
            said.append(diagnostic)
            if diagnostic.ok:
                assert self._client.spin_until(lambda stamp=stamp: stamp in self._client.poses, TIMEOUT)
                assert_close(self._client.poses[stamp], photo.T_map_camera)
                return said
            assert stamp not in self._client.poses
        raise AssertionError(f"not found: {said}")

    def cover(self, images: int) -> None:
        """Cover the lens; images are a second apart."""
        for _ in range(images):
            assert not self.see(COVERED)[0].ok

    def state(self, wanted: str) -> DiagnosticStatus:
        """The state as it is published; it becomes what is wanted."""
        found = self._client.spin_until(lambda: bool(self.states) and self.states[-1].message == wanted, TIMEOUT)
        assert found, self.states[-1:]
        return self.states[-1]


@pytest.fixture(scope="module")
def localizer(room_map_file):
    """One that goes on from its answers, whose view index is built."""
    with running_localizer(map__path=room_map_file, index__build=True, track=True) as process:
        process.wait_for_index()
        yield process


@pytest.fixture
def client(localizer, room_camera):
    with connected_client() as client:
        client.send_camera_info(camera_info_of(room_camera))
        client.call(Empty, "reinitialize_global_localization", Empty.Request())
        yield client
    assert "Traceback" not in localizer.output


@pytest.fixture(params=[True, False], ids=["odometry", "no odometry"])
def robot(request, client):
    # Odometry of a run before is not of this one's times.
    return Robot(client, request.param)


@pytest.fixture
def far(room_photos):
    """The photo that was taken farthest from the first one."""
    start = room_photos[0].T_map_camera
    return max(room_photos, key=lambda photo: np.linalg.norm((invert(start) @ photo.T_map_camera)[:3, 3]))


def start(client: Client, robot: Robot, photo: SimulatedPhoto) -> None:
    """Localize a photo by a prior."""
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    robot.find(photo, 1)


def test_it_says_where_it_looked(client, far):
    """Without a prior in views of the index, one of which sees what the photo shows; with one there first."""
    heard = client.listen(PoseArray, "localizer/searched")
    assert client.spin_until(lambda: client.node.count_publishers("localizer/searched") == 1, TIMEOUT)
    settle(client)
    image = rgb_image(far.image)
    assert client.attempt(image).ok
    assert client.spin_until(lambda: bool(heard), TIMEOUT)
    assert stamp_of(heard[-1]) == stamp_of(image)
    assert heard[-1].header.frame_id == "map"
    centres = np.array([[pose.position.x, pose.position.y, pose.position.z] for pose in heard[-1].poses])
    assert np.linalg.norm(centres - far.T_map_camera[:3, 3], axis=1).min() < 1.0
    client.send_prior(pose_stamped(far.T_map_camera_prior))
    assert client.attempt(rgb_image(far.image)).ok
    assert client.spin_until(lambda: len(heard) > 1, TIMEOUT)
    first = heard[-1].poses[0].position
    np.testing.assert_allclose([first.x, first.y, first.z], far.T_map_camera_prior[:3, 3])


def test_every_photo_is_found_without_a_prior(client, robot, room_photos):
    for photo in room_photos:
        client.call(Empty, "reinitialize_global_localization", Empty.Request())
        said = robot.find(photo, 2)
        assert said[0].values["prior"] == "none"
        if len(said) == 2:
            assert said[0].values["status"] == "unconfirmed"
            assert "found without a prior: the next image has to agree" in said[0].reason
            assert said[1].values["prior"] == "unconfirmed answer"


def test_the_state_is_latched_and_says_since_when(client, robot, photo):
    lost = robot.state("lost")
    values = {item.key: item.value for item in lost.values}
    assert lost.level == DiagnosticStatus.ERROR
    assert values["reason"] == "asked for by reinitialize_global_localization"
    start(client, robot, photo)
    assert robot.state("localized").level == DiagnosticStatus.OK
    assert robot.state("coasting").level == DiagnosticStatus.WARN
    first = float({item.key: item.value for item in robot.states[-1].values}["seconds"])
    count = len(robot.states)
    assert client.spin_until(lambda: len(robot.states) >= count + 2)
    assert float({item.key: item.value for item in robot.states[-1].values}["seconds"]) > first
    late = Robot(client, False)
    assert late.state("coasting").name == "localizer: state"
    assert client.spin_until(lambda: any("coasting" in said.reason for said in client.states))


def test_a_covered_lens(client, robot, photo):
    start(client, robot, photo)
    robot.cover(11)
    assert len(robot.find(photo, 2)) <= 2


def test_a_covered_lens_and_the_robot_goes_on(client, robot, photo, far):
    start(client, robot, photo)
    robot.cover(11)
    assert len(robot.find(far, 2)) <= 2


def test_carried_off(client, robot, photo, far):
    start(client, robot, photo)
    said = robot.find(far, 2)
    # By the localizer's own clock: the client waits between its messages.
    assert sum(float(attempt.values["ms_total"]) for attempt in said) < 1000 * RECOVERY, said


def test_carried_off_farther_than_its_last_answer_would_believe(client, robot, photo, far):
    """The last answer says where to look first; far from it an answer has to be surer, as this one is."""
    assert client.set_parameter("localizer.max_deviation", 1.0).successful
    try:
        client.send_prior(pose_stamped(photo.T_map_camera))
        robot.find(photo, 1)
        assert len(robot.find(far, 3)) <= 3
    finally:
        assert client.set_parameter("localizer.max_deviation", 8.0).successful


def test_odometry_says_where_it_went(client, photo, far):
    """Then nothing has to be confirmed."""
    robot = Robot(client, True)
    start(client, robot, photo)
    moved = invert(photo.T_map_camera) @ far.T_map_camera
    drift = make_pose(so3_exp(np.array([0.0, 0.02, 0.0])), [0.05, 0.0, 0.0])
    diagnostic, stamp = robot.see(far.image, moved @ drift)
    assert diagnostic.ok, diagnostic
    assert diagnostic.values["prior"] == "last answer"
    assert_close(client.poses[stamp], far.T_map_camera)


def request_of(client: Client, camera, photo: SimulatedPhoto, **fields: object) -> LocalizeImage.Request:
    image = rgb_image(photo.image)
    image.header.stamp = client.next_stamp()
    return LocalizeImage.Request(image=image, camera_info=camera_info_of(camera), **fields)


@pytest.mark.parametrize("forget", [False, True])
def test_the_answer_to_a_request_heals_the_stream(client, room_camera, photo, forget):
    robot = Robot(client, False)
    robot.cover(1)
    request = request_of(client, room_camera, photo, forget=forget)
    answer = client.call(LocalizeImage, "localizer/localize_image", request)
    assert answer.status == LocalizeImage.Response.LOCALIZED, answer.reason
    assert_close(answer.pose, photo.T_map_camera)
    assert robot.find(photo, 1)[0].values["prior"] == ("none" if forget else "last answer")


def test_a_request_bounds_the_search(client, room_camera, photo):
    covered = SimulatedPhoto(0.0, np.ascontiguousarray(photo.image[::-1]), np.eye(4), np.eye(4))
    request = request_of(client, room_camera, covered, max_seconds=0.1)
    answer = client.call(LocalizeImage, "localizer/localize_image", request)
    assert answer.status != LocalizeImage.Response.LOCALIZED
    assert answer.reason.startswith("not found within 0.10 s: looked ")
    assert answer.milliseconds < 1500
    request = request_of(client, room_camera, covered, max_seconds=-1.0)
    answer = client.call(LocalizeImage, "localizer/localize_image", request)
    assert answer.status == LocalizeImage.Response.REFUSED
    assert "max_seconds is -1.0" in answer.reason


def test_relocalize_needs_no_prior(client, photo):
    assert client.set_parameter("mode", "on_request").successful
    try:
        image = client.send_once(photo.image)
        client.spin(0.5)
        answer = client.relocalize()
        assert answer.success, answer.message
        assert_close(client.pose_of(image), photo.T_map_camera)
    finally:
        assert client.set_parameter("mode", "continuous").successful


def test_a_prior_that_claims_to_be_better_than_it_is(client, photo):
    """Of 5 cm and 3 degrees, and 0.3 m and 10 degrees off."""
    off = make_pose(so3_exp(np.radians([0.0, 10.0, 0.0])), [0.3, 0.0, 0.0])
    claimed = np.diag(np.square([0.05] * 3 + [np.radians(3.0)] * 3))
    client.send_prior(pose_with_covariance(photo.T_map_camera @ off, claimed))
    Robot(client, False).find(photo, 1)


def test_a_prior_far_from_the_truth(client, photo, far):
    client.send_prior(pose_stamped(far.T_map_camera))
    Robot(client, False).find(photo, 1)
