"""What the localizer does with input that cannot be used: it says what is wrong, publishes no pose, and goes on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from lifecycle_msgs.srv import ChangeState
from node_harness import Client, assert_answer, assert_no_answer, connected_client, running_localizer
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image


@pytest.fixture
def good_prior(photo):
    return pose_stamped(photo.T_map_camera_prior)


@pytest.fixture
def good_info(room_camera):
    return camera_info_of(room_camera)


def send_good_inputs(client: Client, good_info, good_prior) -> None:
    client.send_camera_info(good_info)
    client.send_prior(good_prior)


def check_refusal(client: Client, localizer, image: Image, says: str) -> None:
    """The image gets no pose, for a reason that stands in the diagnostic and in the log."""
    diagnostic = assert_no_answer(client, image, says)
    assert diagnostic.values["status"] in ("refused", "failed")
    localizer.wait_for_output(rf"\[WARN\].*{says}")


def test_neither_a_prior_nor_a_view_index(room_map_file, good_info, good_prior, photo, tmp_path):
    parameters = {"map__path": room_map_file, "index__build": False, "index__path": tmp_path / "none"}
    with running_localizer(**parameters) as localizer, connected_client() as client:
        client.send_camera_info(good_info)
        check_refusal(client, localizer, rgb_image(photo.image), "index")
        client.send_prior(good_prior)
        assert_answer(client, photo)


def test_no_camera_info_yet(room_map_file, good_info, good_prior, photo):
    with (
        running_localizer(map__path=room_map_file, matcher__name="sift") as localizer,
        connected_client() as client,
    ):
        client.send_prior(good_prior)
        check_refusal(client, localizer, rgb_image(photo.image), "no camera_info yet: publish .* on /camera_info")
        client.send_camera_info(good_info)
        assert_answer(client, photo)


def nan_prior(prior):
    prior.pose.position.y = math.nan
    return prior


def zero_quaternion_prior(prior):
    orientation = prior.pose.orientation
    orientation.x = orientation.y = orientation.z = orientation.w = 0.0
    return prior


def nowhere_prior(prior):
    prior.header.frame_id = ""
    return prior


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (nan_prior, "prior has position .* must be finite"),
        (zero_quaternion_prior, "prior cannot be used: quaternion .* has no direction"),
        (nowhere_prior, "prior is in frame '': name the frame"),
    ],
)
def test_prior_that_cannot_be_used(client, localizer, good_info, good_prior, photo, spoil, says):
    send_good_inputs(client, good_info, good_prior)
    bad = spoil(pose_stamped(photo.T_map_camera_prior))
    assert client.until_refused(lambda: client.send_prior(bad), says)
    check_refusal(client, localizer, rgb_image(photo.image), says)
    client.send_prior(good_prior)
    assert_answer(client, photo)


def test_prior_in_a_frame_that_nobody_knows(client, localizer, good_info, good_prior, photo):
    client.send_camera_info(good_info)
    client.send_prior(pose_stamped(photo.T_map_camera_prior, "odom"))
    check_refusal(client, localizer, rgb_image(photo.image), "prior is in frame 'odom' but the map is in 'map': tf")
    client.send_prior(good_prior)
    assert_answer(client, photo)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"k": [0.0] * 9}, "K of zeros, the camera is not calibrated"),
        ({"distortion_model": "thin_prism"}, "distortion model 'thin_prism' is not one of"),
    ],
)
def test_camera_info_that_cannot_be_used(client, localizer, room_camera, good_info, good_prior, photo, changes, says):
    send_good_inputs(client, good_info, good_prior)
    bad = camera_info_of(room_camera)
    for name, value in changes.items():
        setattr(bad, name, value)
    assert client.until_refused(lambda: client.send_camera_info(bad), says)
    check_refusal(client, localizer, rgb_image(photo.image), says)
    client.send_camera_info(good_info)
    assert_answer(client, photo)


def test_camera_info_of_another_size(client, localizer, room_camera, good_info, good_prior, photo):
    bad: CameraInfo = camera_info_of(room_camera.scaled(320, 240))
    send_good_inputs(client, bad, good_prior)
    check_refusal(client, localizer, rgb_image(photo.image), "camera_info is for 320x240 but the image is 640x480")
    client.send_camera_info(good_info)
    assert_answer(client, photo)


def of_unknown_encoding(image):
    image.encoding = "jpeg"
    return image


def cut_short(image):
    image.data = image.data[:-1]
    return image


def of_no_size(image):
    image.width = image.height = image.step = 0
    image.data = []
    return image


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (of_unknown_encoding, "image encoding 'jpeg' is not supported"),
        (cut_short, "image data has 921599 bytes but step 1920 x height 480 needs 921600"),
        (of_no_size, "image size 0x0"),
    ],
)
def test_image_that_cannot_be_decoded(client, localizer, good_info, good_prior, photo, spoil, says):
    send_good_inputs(client, good_info, good_prior)
    check_refusal(client, localizer, spoil(rgb_image(photo.image)), says)
    assert not client.relocalize().success
    assert_answer(client, photo)


def test_image_of_nothing(client, localizer, good_info, good_prior, photo):
    send_good_inputs(client, good_info, good_prior)
    check_refusal(client, localizer, rgb_image(np.zeros_like(photo.image)), "0 corners")
    assert_answer(client, photo)


def test_stream_of_unusable_images_does_not_flood_the_log(client, localizer, photo):
    seen = len(client.diagnostics)
    lines = localizer.output.count("'flood' is not supported")
    for _ in range(30):
        image = rgb_image(photo.image[:4])
        image.encoding = "flood"
        client.send_image(image)
        client.spin(0.05)
    client.spin(0.5)
    assert 1 <= localizer.output.count("'flood' is not supported") - lines <= 4
    assert 1 <= len(client.diagnostics) - seen <= 4


def test_a_parameter_of_no_type_is_refused_and_the_node_goes_on(client, localizer, good_info, good_prior, photo):
    message = Parameter("max_rate", value=1.0).to_parameter_msg()
    message.value.type = 99
    request = SetParameters.Request(parameters=[message])
    (result,) = client.call(SetParameters, "localizer/set_parameters", request).results
    assert not result.successful
    assert result.reason == "'max_rate' cannot be set: 99 is not a valid Parameter.Type"
    send_good_inputs(client, good_info, good_prior)
    assert_answer(client, photo)


def test_texts_from_outside_are_cut(client, localizer, good_info, good_prior, photo):
    before = len(localizer.output)
    send_good_inputs(client, good_info, pose_stamped(photo.T_map_camera_prior, 1_000_000 * "x"))
    diagnostic = assert_no_answer(client, rgb_image(photo.image), r"prior is in frame 'xxx.* \.\.\. \(\d+ characters\)")
    assert len(diagnostic.reason) < 1100
    answer = client.relocalize()
    assert not answer.success
    assert len(answer.message) < 1100
    request = ChangeState.Request()
    request.transition.label = 1_000_000 * "x"
    assert not client.call(ChangeState, "localizer/change_state", request).success
    assert len(localizer.output) - before < 10_000
    client.send_prior(good_prior)
    assert_answer(client, photo)
