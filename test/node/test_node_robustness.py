"""Sensors, clocks and processes round the installed localizer fail: no crash, no wrong pose, always a reason."""

from __future__ import annotations

import re
import signal

import numpy as np
import pytest
from camera_process import running_camera
from diagnostic_msgs.msg import DiagnosticStatus
from node_harness import (
    TIMEOUT,
    Client,
    assert_answer,
    assert_close,
    assert_no_answer,
    connected_client,
    running_localizer,
    send_inputs,
    stamped,
)

from gsfeatloc_ros.client.messages import pose_stamped, rgb_image

# A signal in the middle of a localization may take so long to end the node, in seconds, on a slow machine.
END_TIMEOUT = 8.0


@pytest.fixture(scope="module")
def localizer(room_map_file):
    with running_localizer(map__path=room_map_file, index__build=True, image__timeout=1.0) as process:
        process.wait_for_index()
        yield process


@pytest.fixture
def client(localizer):
    assert localizer.alive, localizer.output
    with connected_client() as client:
        yield client
    assert "Traceback" not in localizer.output


def assert_health(client: Client, level: bytes, says: str = "") -> None:
    """The health soon has this level, for a reason that matches."""
    seen = len(client.health)

    def found() -> bool:
        return any(health.level == level and re.search(says, health.reason) for health in client.health[seen:])

    assert client.spin_until(found, TIMEOUT), client.health[seen:]


def test_sensor_stops_and_returns(client, room_camera, photo):
    send_inputs(client, room_camera, photo)
    assert_answer(client, photo)
    assert_health(client, DiagnosticStatus.ERROR, r"no image for \d+ s: is the camera running\?")
    answer = client.relocalize()
    assert not answer.success
    assert re.fullmatch(r"the newest image came \d+\.\d s ago: is the camera running\?", answer.message)
    assert_answer(client, photo)
    assert client.relocalize().success
    seen = len(client.health)
    while not any(health.ok for health in client.health[seen:]):
        assert_answer(client, photo)
        assert len(client.health) - seen < 20, client.health[seen:]


def test_publisher_is_killed_and_another_one_starts(client, room_camera, photo, tmp_path):
    np.save(tmp_path / "picture.npy", photo.image)
    send_inputs(client, room_camera, photo)

    def assert_served() -> None:
        before = set(client.poses)
        assert client.spin_until(lambda: len(client.poses.keys() - before) >= 3, TIMEOUT)
        for stamp in client.poses.keys() - before:
            assert_close(client.poses[stamp], photo.T_map_camera)

    with running_camera(tmp_path / "picture.npy") as camera:
        assert_served()
        assert_health(client, DiagnosticStatus.OK)
        camera.send_signal(signal.SIGKILL)
        assert_health(client, DiagnosticStatus.ERROR, "no image for")
        answer = client.relocalize()
        assert not answer.success
        assert "is the camera running?" in answer.message
    with running_camera(tmp_path / "picture.npy"):
        assert_served()
        assert_health(client, DiagnosticStatus.OK)


@pytest.mark.parametrize("jump", [[100.0, 0.0, 0.0], [0.0, -100.0, 0.0], [0.0, 0.0, 100.0]])
def test_prior_jumps_100_m(client, room_camera, photo, jump):
    """Never a wrong pose: the right one, or none that is so far from what was claimed."""
    send_inputs(client, room_camera, photo)
    assert_answer(client, photo)
    far = photo.T_map_camera_prior.copy()
    far[:3, 3] += jump
    client.send_prior(pose_stamped(far))
    image = rgb_image(photo.image)
    said = client.attempt(image)
    if said.ok:
        assert_close(client.pose_of(image), photo.T_map_camera)
    else:
        assert "standard deviations from the prior" in said.reason
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    assert_answer(client, photo)


def test_prior_stale_or_of_the_future(client, room_camera, photo):
    image = rgb_image(photo.image)
    send_inputs(client, room_camera, photo)
    client.send_prior(stamped(pose_stamped(photo.T_map_camera_prior), 100_000))
    assert_answer(client, photo, 100_009)
    # An old one means a wider search.
    assert_answer(client, photo, 100_011)
    assert float(client.diagnostics[-1].values["prior_sigma"]) > 10.0
    assert_no_answer(client, image, r"prior is 11\.0 s newer than the image .*prior_max_age.*clocks", 99_989)
    assert_answer(client, photo, 99_991)


def test_stamps_go_back(client, room_camera, photo):
    image = rgb_image(photo.image)
    send_inputs(client, room_camera, photo)
    prior = pose_stamped(photo.T_map_camera_prior)
    client.send_prior(stamped(prior, 200_100))
    assert_answer(client, photo, 200_100)
    assert_no_answer(client, image, r"prior is 100\.0 s newer than the image .*prior_max_age", 200_000)
    client.send_prior(stamped(prior, 200_000))
    assert_answer(client, photo, 200_000)
    # Late, and out of order.
    client.send_prior(stamped(prior, 199_900))
    assert_answer(client, photo, 200_001)
    assert float(client.diagnostics[-1].values["prior_sigma"]) > 99.0
