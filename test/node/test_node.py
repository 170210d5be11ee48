"""The installed localizer over DDS: what it does with good input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gsfeatloc_interfaces.msg import ProtectionLevel
from gsfeatloc_interfaces.srv import LocalizeImage
from node_harness import SILENCE, assert_close, connected_client, send_inputs
from sensor_msgs.msg import Image

from gsfeatloc_ros.client.messages import camera_info_of, rgb_image, stamp_of
from gsfeatloc_ros.localize.evidence import Evidence, Limits
from gsfeatloc_ros.localize.protection import protection_level
from gsfeatloc_ros.node.qos import LATCHED


def test_image_and_prior_give_the_pose(client, room_camera, photo):
    send_inputs(client, room_camera, photo)
    image = rgb_image(photo.image)
    diagnostic = client.attempt(image)
    assert diagnostic.ok, diagnostic
    assert diagnostic.values["status"] == "localized"
    assert int(diagnostic.values["inliers"]) >= 20
    assert float(diagnostic.values["ms_total"]) > 0
    assert Evidence().numbers().keys() <= diagnostic.values.keys()
    assert -1 <= float(diagnostic.values["correlation"]) <= 1
    assert "ms_verify" in diagnostic.values
    pose = client.pose_of(image)
    assert pose.header.frame_id == "map"
    assert pose.header.stamp == image.header.stamp
    assert_close(pose, photo.T_map_camera)
    covariance = np.reshape(pose.pose.covariance, (6, 6))
    assert np.allclose(covariance, covariance.T)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    # A standard deviation in metres and radians that a pose within 2 cm and 1 degree can have.
    assert np.sqrt(np.diag(covariance)).max() < 0.1


def test_late_subscriber_gets_the_last_pose(client, room_camera, photo):
    send_inputs(client, room_camera, photo)
    image = rgb_image(photo.image)
    assert client.attempt(image).ok
    with connected_client() as late:
        assert late.pose_of(image) is not None


def test_rendered_image_is_the_map_seen_from_the_estimate(client, room, room_camera, photo):
    client.listen_to_renders()
    send_inputs(client, room_camera, photo)
    image = rgb_image(photo.image)
    assert client.attempt(image).ok
    assert client.spin_until(lambda: any(stamp_of(render) == stamp_of(image) for render in client.renders))
    render = next(render for render in client.renders if stamp_of(render) == stamp_of(image))
    assert (render.encoding, render.header.frame_id) == ("rgb8", "camera_optical")
    rendered = np.frombuffer(render.data, np.uint8).reshape(render.height, render.width, 3) / 255.0
    # The room as a pinhole camera at the true pose would see it.
    pinhole = replace(room_camera.scaled(render.width, render.height), distortion=np.zeros(0))
    seen = room.ray_trace(pinhole, photo.T_map_camera).rgb
    assert np.corrcoef(rendered.ravel(), seen.ravel())[0, 1] > 0.9


def covered(pixels: np.ndarray) -> np.ndarray:
    """A photo (480, 640, 3) with a chequered board before the camera, in rows 100 to 339 and columns 160 to 399."""
    squares = np.random.default_rng(0).integers(0, 256, (12, 12, 3), dtype=np.uint8)
    photo = pixels.copy()
    photo[100:340, 160:400] = squares.repeat(20, axis=0).repeat(20, axis=1)
    return photo


def mask_of(client, masks: list[Image], image: Image) -> np.ndarray:
    """The mask (H, W) that came for an image."""
    assert client.spin_until(lambda: any(stamp_of(mask) == stamp_of(image) for mask in masks))
    mask = next(mask for mask in masks if stamp_of(mask) == stamp_of(image))
    assert (mask.encoding, mask.header.frame_id) == ("mono8", "camera_optical")
    assert (mask.width, mask.height, mask.step) == (640, 480, 640)
    pixels = np.frombuffer(mask.data, np.uint8).reshape(mask.height, mask.width)
    assert set(np.unique(pixels)) <= {0, 255}
    return pixels > 0


def test_changed_is_where_the_photo_is_not_as_in_the_map(client, room_camera, photo):
    masks = client.listen(Image, "localizer/changed")
    assert client.spin_until(lambda: client.node.count_publishers("localizer/changed") == 1)
    send_inputs(client, room_camera, photo)
    image = rgb_image(covered(photo.image))
    diagnostic = client.attempt(image)
    assert diagnostic.ok, diagnostic
    mask = mask_of(client, masks, image)
    # Without the lens's distortion the board is about there.
    board = np.zeros_like(mask)
    board[130:310, 190:370] = True
    assert mask[board].mean() > 0.8
    board[70:370, 130:430] = True
    assert mask[~board].mean() < 0.05
    assert float(diagnostic.values["changed"]) == pytest.approx(mask.mean(), abs=0.1)
    image = rgb_image(photo.image)
    assert client.attempt(image).ok
    assert mask_of(client, masks, image).mean() < 0.02


def test_changed_is_of_rejected_images_too_and_not_of_those_without_a_pose(client, room_camera, photo):
    masks = client.listen(Image, "localizer/changed")
    assert client.spin_until(lambda: client.node.count_publishers("localizer/changed") == 1)
    send_inputs(client, room_camera, photo)
    assert client.set_parameter("localizer.min_inliers", 800).successful
    try:
        image = rgb_image(photo.image)
        assert client.attempt(image).values["status"] == "rejected"
        assert mask_of(client, masks, image).mean() < 0.02
    finally:
        assert client.set_parameter("localizer.min_inliers", 20).successful
    image = rgb_image(np.zeros_like(photo.image))
    assert client.attempt(image).values["status"] == "failed"
    client.spin(SILENCE)
    assert not any(stamp_of(mask) == stamp_of(image) for mask in masks)


def test_protection_level_is_published_beside_the_pose(client, room_camera, photo):
    levels: list[ProtectionLevel] = []
    client.node.create_subscription(ProtectionLevel, "protection_level", levels.append, LATCHED)
    send_inputs(client, room_camera, photo)
    image = rgb_image(photo.image)
    values = client.attempt(image).values
    pose = client.pose_of(image)
    assert client.spin_until(lambda: any(stamp_of(level) == stamp_of(image) for level in levels))
    level = next(level for level in levels if stamp_of(level) == stamp_of(image))
    assert level.header == pose.header
    assert level.risk == 1e-3
    expected = protection_level(np.reshape(pose.pose.covariance, (6, 6)))
    assert (level.radius, level.angle) == pytest.approx((expected.radius, expected.angle))
    assert 0 < level.radius < 0.2
    assert float(values["protection_radius"]) == pytest.approx(level.radius, rel=0.05)
    assert float(values["protection_angle_deg"]) == pytest.approx(np.degrees(level.angle), rel=0.05)
    # Nothing is said of what is no answer.
    image = rgb_image(np.zeros_like(photo.image))
    assert "protection_radius" not in client.attempt(image).values
    client.spin(SILENCE)
    assert not any(stamp_of(level) == stamp_of(image) for level in levels)


def test_localize_image_says_how_sure_it_is(client, room_camera, photo):
    send_inputs(client, room_camera, photo)
    request = LocalizeImage.Request(image=rgb_image(photo.image), camera_info=camera_info_of(room_camera))
    response = client.call(LocalizeImage, "localizer/localize_image", request)
    assert response.status == response.LOCALIZED, response.reason
    assert 0 < response.probability_wrong <= Limits().max_risk
    expected = protection_level(np.reshape(response.pose.pose.covariance, (6, 6)))
    assert response.protection_radius == pytest.approx(expected.radius)
    assert response.protection_angle == pytest.approx(expected.angle)
    for pixels in (np.zeros_like(photo.image), photo.image[:240, :320]):
        request.image = rgb_image(pixels)
        response = client.call(LocalizeImage, "localizer/localize_image", request)
        assert response.status in (response.FAILED, response.REFUSED)
        assert np.isnan([response.probability_wrong, response.protection_radius, response.protection_angle]).all()


def test_risk_that_is_accepted_can_be_set(client, room_camera, photo):
    send_inputs(client, room_camera, photo)
    request = LocalizeImage.Request(image=rgb_image(covered(photo.image)), camera_info=camera_info_of(room_camera))
    assert client.set_parameter("localizer.max_risk", 1e-9).successful
    try:
        diagnostic = client.attempt(request.image)
        response = client.call(LocalizeImage, "localizer/localize_image", request)
    finally:
        assert client.set_parameter("localizer.max_risk", Limits().max_risk).successful
    assert (float(diagnostic.values["probability_wrong"]) > 1e-9) == (not diagnostic.ok)
    assert (response.probability_wrong > 1e-9) == (response.status == response.REJECTED)
    assert client.attempt(request.image).ok


def test_service_localizes_the_newest_image(client, room_camera, photo):
    send_inputs(client, room_camera, photo)
    image = rgb_image(photo.image)
    assert client.attempt(image).ok
    client.poses.clear()
    answer = client.relocalize()
    assert answer.success, answer.message
    assert_close(client.pose_of(image), photo.T_map_camera)


def test_service_tells_of_failure(client, room_camera, photo):
    send_inputs(client, room_camera, photo)
    image = rgb_image(np.zeros_like(photo.image))
    assert not client.attempt(image).ok
    answer = client.relocalize()
    assert not answer.success
    assert "corners" in answer.message
    assert client.pose_of(image) is None


def test_requests_at_once_are_all_answered(client, room_camera, photo):
    send_inputs(client, room_camera, photo)
    assert client.attempt(rgb_image(photo.image)).ok
    answers = client.relocalize_together(8)
    assert all(answer.success for answer in answers)


def test_newest_image_wins_and_every_one_is_accounted_for(client, room_camera, photo):
    send_inputs(client, room_camera, photo)
    before = client.attempt(rgb_image(photo.image)).values
    seen = len(client.diagnostics)
    for _ in range(30):
        image = rgb_image(photo.image)
        image.header.stamp = client.next_stamp()
        client.send_image(image)
        client.spin(0.02)
    last = client.attempt(rgb_image(photo.image))
    assert last.ok
    client.spin(1.0)
    attempts = client.diagnostics[seen:]
    received = int(attempts[-1].values["images_received"]) - int(before["images_received"])
    dropped = int(attempts[-1].values["images_dropped"]) - int(before["images_dropped"])
    assert dropped > 0
    assert received - dropped == len(attempts)
    stamps = [float(diagnostic.values["stamp"]) for diagnostic in attempts]
    assert stamps == sorted(stamps)
