"""The installed localizer with what other cameras and estimators send: compressed, rectified, unsure."""

from __future__ import annotations

import numpy as np
import pytest
from node_harness import assert_close, compressed_image, connected_client, running_localizer
from sensor_msgs.msg import CompressedImage

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, pose_with_covariance
from gsfeatloc_ros.common.geometry import make_pose, so3_exp


@pytest.fixture(scope="module")
def localizer(room_map_file, tmp_path_factory):
    """Without an index: what a prior does not show is searched round it."""
    index = {"index__build": False, "index__path": tmp_path_factory.mktemp("none") / "index"}
    images = {"image__transport": "compressed", "image__rectified": True}
    with running_localizer(map__path=room_map_file, **images, **index) as process:
        yield process


@pytest.fixture
def client(localizer):
    with connected_client("compressed") as client:
        yield client


@pytest.fixture
def rectified_info(room_camera):
    """As a stereo driver sends it: K and D are of the raw image, P of the rectified one."""
    info = camera_info_of(room_camera)
    info.p = np.column_stack([room_camera.K, np.zeros(3)]).ravel().tolist()
    return info


@pytest.mark.parametrize("extension", ["png", "jpg"])
def test_compressed_rectified_images_are_localized(client, room_camera, rectified_info, photo, extension):
    client.send_camera_info(rectified_info)
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    image = compressed_image(room_camera.undistort_image(photo.image), extension)
    diagnostic = client.attempt(image)
    assert diagnostic.ok, diagnostic
    assert_close(client.pose_of(image), photo.T_map_camera)


def test_camera_info_without_p_is_refused(client, room_camera):
    client.until_refused(lambda: client.send_camera_info(camera_info_of(room_camera)), "a P of zeros")


def test_a_damaged_image_is_refused(client, rectified_info, photo):
    client.send_camera_info(rectified_info)
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    diagnostic = client.attempt(CompressedImage(format="jpeg", data=b"\xff\xd8\xff no picture"))
    assert diagnostic.values["status"] == "refused"
    assert "damaged" in diagnostic.reason
    assert client.attempt(compressed_image(photo.image, "png")).values["status"] != "refused"


def test_the_priors_covariance_says_where_to_search(client, room_camera, rectified_info, photo):
    client.send_camera_info(rectified_info)
    away = photo.T_map_camera @ make_pose(so3_exp(np.radians([0.0, 100.0, 0.0])), np.zeros(3))
    image = compressed_image(room_camera.undistort_image(photo.image), "png")
    client.send_prior(pose_with_covariance(away, np.diag([1e-4] * 3 + [1e-4] * 3)))
    assert client.attempt(image).values["status"] in ("failed", "rejected")
    client.send_prior(pose_with_covariance(away, np.diag([0.01] * 3 + [1.0] * 3)))
    diagnostic = client.attempt(image)
    assert diagnostic.ok, diagnostic
    assert int(diagnostic.values["views"]) > 0
    assert_close(client.pose_of(image), photo.T_map_camera)


@pytest.mark.parametrize("value", [float("inf"), -2.0])
def test_a_covariance_that_is_none_is_refused(client, photo, value):
    covariance = np.diag([value] * 6)
    message = pose_with_covariance(photo.T_map_camera, covariance)
    client.until_refused(lambda: client.send_prior(message), "prior has covariance")
