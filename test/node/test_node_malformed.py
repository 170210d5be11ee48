"""Messages that no sensor should send, hundreds of them: the installed localizer says why not, and serves on.

Each is drawn with the reason that is expected for it; ~/relocalize then gives that reason, however many came before.
"""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from gsfeatloc_interfaces.srv import LocalizeImage
from hypothesis import given
from hypothesis import strategies as st
from malformed import ARRIVAL, assert_refused, camera_infos, examples, images, not_finite, poses, stamps, words
from nav_msgs.msg import Odometry
from node_harness import SILENCE, Client, assert_answer, assert_close, connected_client, running_localizer, send_inputs
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image

from gsfeatloc_ros.client.messages import (
    Diagnostic,
    camera_info_of,
    pose_stamped,
    pose_with_covariance,
    rgb_image,
    stamp_of,
)
from gsfeatloc_ros.common.geometry import make_pose
from gsfeatloc_ros.simulate import SimulatedPhoto

# Few views, so that a prior that leads nowhere is soon given up; the base is the camera, so that no tf is needed.
PARAMETERS = {"matcher__name": "sift", "localizer__max_views": 4, "base_frame": "camera_optical", "track": "true"}


@pytest.fixture(scope="module")
def localizer(room_map_file):
    with running_localizer(map__path=room_map_file, **PARAMETERS) as process:
        yield process


# One for all tests: to find each other takes longer than all the rest.
@pytest.fixture(scope="module")
def client(localizer, room_camera, room_photos):
    with connected_client() as client:
        send_good(client, room_camera, room_photos[0])
        yield client


@pytest.fixture
def good(client, localizer, room_camera, photo):
    """The localizer with good inputs; after a test it is still there and able to answer."""
    assert localizer.alive, localizer.output
    printed = len(localizer.output)
    yield client
    assert "Traceback" not in localizer.output[printed:]
    send_good(client, room_camera, photo)


def send_good(client: Client, camera, photo) -> None:
    send_inputs(client, camera, photo)
    assert_answer(client, photo)


# Messages of each topic


def test_images(good):
    @examples(60)
    @given(images())
    def check(case):
        assert_refused(good, "image", *case)

    check()


def test_camera_infos(good, room_camera):
    @examples(50)
    @given(camera_infos(room_camera))
    def check(case):
        assert_refused(good, "camera_info", *case)

    check()


@pytest.mark.parametrize(
    ("topic", "message_type", "name"),
    [
        ("prior", PoseStamped, "prior"),
        ("prior_with_covariance", PoseWithCovarianceStamped, "prior"),
        ("initialpose", PoseWithCovarianceStamped, "initialpose"),
    ],
)
def test_priors(good, photo, topic, message_type, name):
    @examples(25)
    @given(poses(pose_stamped(photo.T_map_camera_prior), message_type, name))
    def check(case):
        assert_refused(good, topic, *case)

    check()


def test_odometry(good, localizer, photo):
    """It says nothing of where the robot is: what is malformed is said, and the prior is still good."""

    @examples(20)
    @given(st.data())
    def check(data):
        odometry = Odometry(child_frame_id=data.draw(words))
        odometry.header.stamp, odometry.header.frame_id = data.draw(stamps), data.draw(words)
        part = data.draw(st.sampled_from([odometry.pose.pose.position, odometry.pose.pose.orientation]))
        part.x = data.draw(not_finite)
        good.publisher("odom", Odometry).publish(odometry)

    check()
    localizer.wait_for_output(r"\[WARN\].*odom has position .* must be finite")
    assert_answer(good, photo)


# What is finite, and yet no camera has it and no robot is there

ABSURD_CAMERAS = [
    {"k": [1e-300, 0.0, 322.0, 0.0, 1e-300, 236.0, 0.0, 0.0, 1.0]},
    {"k": [1e300, 0.0, 322.0, 0.0, 1e300, 236.0, 0.0, 0.0, 1.0]},
    {"k": [1e-3, 0.0, 322.0, 0.0, 1e6, 236.0, 0.0, 0.0, 1.0]},
    {"k": [500.0, 0.0, 1e300, 0.0, 502.0, -1e300, 0.0, 0.0, 1.0]},
    {"k": [500.0, 0.0, 1e9, 0.0, 502.0, 236.0, 0.0, 0.0, 1.0]},
    {"k": [500.0, 1e300, 322.0, 0.0, 502.0, 236.0, 0.0, 0.0, 1.0]},
    {"d": [1e30, -1e30, 1e30, 1e30, 1e30]},
    {"d": [1e308, 1e308, 1e308, 1e308, 1e308]},
    {"d": [-1e6, 0.0, 0.0, 0.0, 0.0]},
    {"d": [1e30, 1e30, -1e30, 1e30], "distortion_model": "equidistant"},
    {"d": [1e300] * 8, "distortion_model": "rational_polynomial"},
]

ABSURD_COVARIANCES = {
    "all 1e308": np.full((6, 6), 1e308),
    "all 1e20": np.full((6, 6), 1e20),
    "variances of 1e308": np.diag([1e308] * 6),
    "variances of 1e150": np.diag([1e150] * 6),
    "variances of 1e20": np.diag([1e20] * 6),
    "variances of 1e-320": np.diag([1e-320] * 6),
    "slightly indefinite": np.eye(6) - 0.9 * np.ones((6, 6)),
    "indefinite": np.eye(6) + 1e3 * (np.ones((6, 6)) - np.eye(6)),
    "not symmetric": np.triu(np.ones((6, 6))),
    "not symmetric, 1e308": np.eye(6) + np.diag([1e308] * 5, k=1),
}


def attempt_without_pose(client: Client, image: Image, about: object) -> Diagnostic:
    """An image is not answered, for a reason that the localizer foresaw."""
    diagnostic = client.attempt(image)
    assert diagnostic.values["status"] in ("refused", "failed", "rejected"), (about, diagnostic)
    assert diagnostic.reason
    return diagnostic


def assert_right_or_no_pose(client: Client, photo: SimulatedPhoto, about: object) -> None:
    """A photo gets its pose, or none for a reason that the localizer foresaw."""
    image = rgb_image(photo.image)
    diagnostic = client.attempt(image)
    assert diagnostic.values["status"] in ("localized", "refused", "failed", "rejected"), (about, diagnostic)
    pose = client.pose_of(image)
    assert diagnostic.ok == (pose is not None), about
    if pose is not None:
        assert_close(pose, photo.T_map_camera)


def assert_no_pose_came(client: Client, before: set[str]) -> None:
    """None was published since those `before`."""
    client.spin(SILENCE)
    assert client.poses.keys() == before


def test_cameras_of_absurd_values(good, room_camera, photo):
    before = set(good.poses)
    for changes in ABSURD_CAMERAS:
        info = camera_info_of(room_camera)
        for name, value in changes.items():
            setattr(info, name, value)
        good.send_camera_info(info)
        attempt_without_pose(good, rgb_image(photo.image), changes)
    assert_no_pose_came(good, before)


def test_tiny_images(good, room_camera):
    before = set(good.poses)
    for width, height in ((1, 1), (2, 1), (1, 200), (8, 8), (3, 2000)):
        good.send_camera_info(camera_info_of(room_camera.scaled(width, height)))
        image = rgb_image(np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8))
        attempt_without_pose(good, image, (width, height))
    assert_no_pose_came(good, before)


def test_priors_of_absurd_places(good, photo):
    """The index finds the photo in spite of them, or nothing does."""
    for far in (1e4, 1e9, 1e20, 1e38, 1e200, 1e308):
        good.send_prior(pose_with_covariance(make_pose(np.eye(3), [-far, far, -far])))
        assert_right_or_no_pose(good, photo, far)


@pytest.mark.parametrize("topic", ["prior_with_covariance", "initialpose"])
def test_priors_of_absurd_covariances(good, photo, topic):
    """The place is right: there is the right answer, or none."""
    for name, covariance in ABSURD_COVARIANCES.items():
        good.publish(topic, pose_with_covariance(photo.T_map_camera_prior, covariance))
        image = rgb_image(photo.image)
        diagnostic = good.attempt(image)
        assert diagnostic.values["status"] in ("localized", "refused", "failed", "rejected"), (name, diagnostic)
        if diagnostic.ok:
            assert_close(good.pose_of(image), photo.T_map_camera)
        else:
            assert stamp_of(image) not in good.poses, name


def test_impossible_correlations_lead_to_no_wrong_pose(good, photo):
    """Nor does a prior that is sure of a wrong place."""
    T_map_camera_prior = photo.T_map_camera.copy()
    T_map_camera_prior[:3, 3] -= 0.7 * T_map_camera_prior[:3, 2]
    for correlation in (0.0, 1e4, 1e6):
        covariance = 1e-6 * ((1.0 - correlation) * np.eye(6) + correlation * np.ones((6, 6)))
        good.send_prior(pose_with_covariance(T_map_camera_prior, covariance))
        assert_right_or_no_pose(good, photo, correlation)


def test_stamps_of_no_time(good, photo):
    """The prior has none, so that it holds at any time."""
    for sec, nanosec in ((-1, 0), (-(2**31), 2**32 - 1), (2**31 - 1, 2**32 - 1), (5, 2**32 - 1), (0, 0)):
        good.send_prior(pose_stamped(photo.T_map_camera_prior))
        image = rgb_image(photo.image)
        image.header.stamp = Time(sec=sec, nanosec=nanosec)
        diagnostic = good.attempt_as_stamped(image)
        if diagnostic.ok:
            assert_close(good.pose_of(image), photo.T_map_camera)
        else:
            assert diagnostic.values["status"] == "refused", diagnostic
            assert stamp_of(image) not in good.poses


# Bytes that are no message


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("image", Image(encoding="rgb8", width=4, height=4, step=12, data=bytes(48))),
        ("camera_info", CameraInfo(d=[0.0] * 5, distortion_model="plumb_bob")),
        ("prior", PoseStamped()),
        ("prior_with_covariance", PoseWithCovarianceStamped()),
        ("initialpose", PoseWithCovarianceStamped()),
        ("odom", Odometry()),
    ],
)
def test_bytes_that_are_no_message(good, topic, message):
    encoded = serialize_message(message)
    # How the encoding begins: CDR, little-endian.
    header = encoded[:4]

    @examples(12)
    @given(st.data())
    def check(data):
        def random() -> bytes:
            return header + data.draw(st.binary(max_size=300))

        def truncated() -> bytes:
            return encoded[: data.draw(st.integers(4, len(encoded) - 1))]

        def damaged() -> bytes:
            damage = bytearray(encoded)
            # Lengths of strings and of sequences among them.
            place = data.draw(st.integers(1, len(encoded) // 4 - 1))
            damage[4 * place : 4 * place + 4] = data.draw(st.binary(min_size=4, max_size=4))
            return bytes(damage)

        good.publisher(topic, type(message)).publish(data.draw(st.sampled_from([random, truncated, damaged]))())
        good.spin(ARRIVAL)

    check()


# Requests


def test_requests_to_localize_an_image(good, room_camera, photo):
    """The camera and the prior of the topics are good: what is wrong is the request's alone."""
    prior = pose_stamped(photo.T_map_camera_prior)

    def check(request: LocalizeImage.Request, says: str) -> None:
        response = good.call(LocalizeImage, "localizer/localize_image", request)
        assert response.status == LocalizeImage.Response.REFUSED
        assert re.search(says, response.reason, re.DOTALL), (says, response.reason)
        assert response.pose == PoseWithCovarianceStamped()

    check(LocalizeImage.Request(), "image encoding '' is not supported")

    @examples(10)
    @given(images())
    def check_image(case):
        image, says = case
        if "camera_info is for" not in says:
            check(LocalizeImage.Request(image=image, camera_info=camera_info_of(room_camera)), says)

    @examples(10)
    @given(camera_infos(room_camera))
    def check_camera(case):
        info, says = case
        check(LocalizeImage.Request(image=rgb_image(photo.image), camera_info=info), says)

    @examples(10)
    @given(poses(prior, PoseWithCovarianceStamped, "prior"))
    def check_prior(case):
        message, says = case
        image = rgb_image(photo.image)
        image.header.stamp = Time(sec=1)
        check(
            LocalizeImage.Request(image=image, camera_info=camera_info_of(room_camera), has_prior=True, prior=message),
            says,
        )

    check_image()
    check_camera()
    check_prior()


PARAMETERS_REFUSED = [
    ("mode", "sometimes"),
    ("mode", 1),
    ("max_rate", -1.0),
    ("max_rate", math.nan),
    ("max_rate", math.inf),
    ("max_rate", "fast"),
    ("prior_max_age", math.nan),
    ("prior_max_age", True),
    ("image.timeout", 0.0),
    ("image.timeout", math.nan),
    ("map.path", 1.5),
    ("map.path", ["a", "b"]),
    ("map.path", None),
    ("map.frame_id", "odom"),
    ("map.scale", 2.0),
    ("track", False),
    ("localizer.max_views", -1),
    ("localizer.max_views", 2**62),
    ("localizer.max_views", 3.0),
    ("localizer.min_inliers", 0),
    ("localizer.max_deviation", math.nan),
    ("localizer.max_risk", math.nan),
    ("localizer.max_risk", 0.0),
    ("localizer.max_risk", 2.0),
    ("localizer.min_coverage", math.nan),
    ("localizer.max_image_width", 1),
    ("localizer.seed", -1),
]


def test_parameters_that_cannot_be_set(good):
    for name, value in PARAMETERS_REFUSED:
        before = good.parameter(name)
        result = good.set_parameter(name, value)
        assert not result.successful, (name, value)
        assert result.reason
        assert good.parameter(name) == before
