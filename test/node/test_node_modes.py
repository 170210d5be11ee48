"""When the installed localizer works, and what can be changed while it runs."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from node_harness import TIMEOUT, assert_close, connected_client
from rcl_interfaces.srv import DescribeParameters
from sensor_msgs.msg import Image

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, pose_with_covariance, rgb_image, stamp_of
from gsfeatloc_ros.ros_io.settings import PARAMETERS


@pytest.fixture
def client(localizer, room_camera):
    with connected_client() as client:
        client.send_camera_info(camera_info_of(room_camera))
        yield client
        for name, value in {"mode": "continuous", "max_rate": 0.0}.items():
            assert client.set_parameter(name, value).successful


def test_on_request_only_services_localize(client, photo):
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    assert client.set_parameter("mode", "on_request").successful
    image = client.send_once(photo.image)
    assert not client.is_tried(image)
    answer = client.relocalize()
    assert answer.success, answer.message
    assert_close(client.pose_of(image), photo.T_map_camera)


def test_on_prior_one_image_for_each(client, photo):
    assert client.set_parameter("mode", "on_prior").successful
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    for _ in range(2):
        image = client.send_once(photo.image)
        assert client.is_tried(image, TIMEOUT)
        assert_close(client.pose_of(image), photo.T_map_camera)
        assert not client.is_tried(client.send_once(photo.image), 1.0)
        client.send_prior(pose_stamped(photo.T_map_camera_prior))


def test_no_more_images_a_second_than_allowed(client, photo):
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    assert client.set_parameter("max_rate", 0.5).successful
    # Stamps are a second apart: of four images two are tried.
    images = []
    for _ in range(4):
        images.append(client.send_once(photo.image))
        client.spin(1.0)
    assert [client.is_tried(image, 1.0) for image in images].count(True) == 2


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("mode", "always", "'always' is not one of continuous, on_prior, on_request"),
        ("max_rate", -1.0, "range"),
        ("max_rate", "fast", "type"),
        ("localizer.min_inliers", 3, "range"),
        ("matcher.name", "xfeat", "read-only"),
        ("map.path", "/nowhere/room.ply", "there is no '/nowhere/room.ply'"),
    ],
)
def test_parameters_that_cannot_be_set_stay_as_they_are(client, name, value, says):
    before = client.parameter(name)
    result = client.set_parameter(name, value)
    assert not result.successful
    assert says in result.reason
    assert client.parameter(name) == before


def test_options_of_the_localizer_change_while_it_runs(client, photo):
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    # Without a search, which would find no other answer.
    for name, value in {"localizer.min_inliers": 800, "localizer.max_views": 0}.items():
        assert client.set_parameter(name, value).successful
    refused = client.attempt(rgb_image(photo.image))
    assert refused.values["status"] == "rejected"
    assert "at least 800 needed" in refused.reason
    for name, value in {"localizer.min_inliers": 20, "localizer.max_views": 32}.items():
        assert client.set_parameter(name, value).successful
    assert client.attempt(rgb_image(photo.image)).ok


@pytest.mark.nightly
def test_whatever_number_is_allowed_leads_to_an_answer_or_a_reason(client, photo):
    """The least and the greatest of each that can be set while it runs; with its default all is as it was."""
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    numbers = [item for item in PARAMETERS if item.live and item.bounds is not None]
    assert len(numbers) > 20
    for item in numbers:
        for bound in item.bounds:
            assert client.set_parameter(item.name, type(item.default)(bound)).successful, (item.name, bound)
            said = client.attempt(rgb_image(photo.image))
            assert said.values["status"] in ("localized", "rejected", "failed"), (item.name, bound, said.reason)
        assert client.set_parameter(item.name, item.default).successful
    assert client.attempt(rgb_image(photo.image)).ok


def test_descriptions_say_which_parameters_can_be_set(client):
    request = DescribeParameters.Request(names=["mode", "matcher.name"])
    mode, matcher = client.call(DescribeParameters, "localizer/describe_parameters", request).descriptors
    assert not mode.read_only
    assert matcher.read_only
    assert mode.additional_constraints == "One of continuous, on_prior, on_request."


def test_health_says_how_it_goes(client, room_map_file, photo):
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    assert client.attempt(rgb_image(photo.image)).ok
    seen = len(client.health)
    assert client.spin_until(lambda: len(client.health) > seen)
    values = client.health[-1].values
    assert values["map"] == str(room_map_file)
    assert (values["mode"], values["device"]) == ("continuous", "cpu")
    assert float(values["image_rate"]) > 0
    assert float(values["answer_rate"]) > 0
    assert 0 < float(values["acceptance"]) <= 1
    assert float(values["ms_total"]) > 0
    assert float(values["answer_age"]) > 0
    assert "inliers of" in values["last_reason"]


def test_health_says_that_camera_info_is_of_another_stream(client, room_camera, photo):
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    K = room_camera.K * [[1.04], [1.04], [1.0]]
    K[:2, 2] = room_camera.K[:2, 2]
    client.send_camera_info(camera_info_of(replace(room_camera, K=K)))
    assert client.set_parameter("localizer.max_views", 0).successful
    try:
        for _ in range(10):
            refused = client.attempt(rgb_image(photo.image))
            assert refused.values["status"] == "rejected"
            assert "is camera_info of this stream?" in refused.reason
        seen = len(client.health)
        assert client.spin_until(lambda: len(client.health) > seen)
        health = client.health[-1]
        assert health.level == DiagnosticStatus.WARN
        words = r"the focal length fits [34]\.\d \+- 0\.\d % shorter than camera_info says, by \d+ answers"
        assert re.match(words, health.reason), health
        assert float(health.values["focal_error"]) == pytest.approx(1 / 1.04 - 1, abs=0.01)
        assert float(health.values["focal_sigma"]) < 0.006
        assert int(health.values["focal_answers"]) >= 10
    finally:
        assert client.set_parameter("localizer.max_views", 32).successful
    # With the right one it starts anew.
    client.send_camera_info(camera_info_of(room_camera))
    assert client.attempt(rgb_image(photo.image)).ok
    seen = len(client.health)
    assert client.spin_until(lambda: len(client.health) > seen)
    assert int(client.health[-1].values["focal_answers"]) < 10
    assert "focal length fits" not in client.health[-1].reason


def test_debug_image_shows_photo_and_render_and_is_drawn_for_refused_ones_too(client, room_camera, photo):
    pictures = client.listen(Image, "debug_image")
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    for info in (camera_info_of(room_camera), camera_info_of(room_camera.scaled(320, 240))):
        client.send_camera_info(info)
        image = rgb_image(photo.image)
        client.attempt(image)
        assert client.spin_until(lambda image=image: any(stamp_of(picture) == stamp_of(image) for picture in pictures))
        picture = pictures[-1]
        pixels = np.frombuffer(picture.data, np.uint8).reshape(picture.height, picture.width, 3)
        assert picture.width == 1280
        assert pixels[:480, :640].std() > 10
        assert (pixels[:480, 640:].std() > 20) == (info.width == 640)


def test_initialpose_needs_tf(client, photo):
    client.publish("initialpose", pose_with_covariance(photo.T_map_camera_prior))
    refused = client.attempt(rgb_image(photo.image))
    assert refused.values["status"] == "refused"
    assert "tf" in refused.reason
    assert not client.relocalize().success
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    assert client.attempt(rgb_image(photo.image)).ok
