"""The installed localizer over DDS: what it does with good input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from node_harness import assert_close, connected_client, send_inputs

from gsfeatloc_ros.client.messages import rgb_image, stamp_of
from gsfeatloc_ros.localize.evidence import Evidence


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
    assert "features" in answer.message
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
