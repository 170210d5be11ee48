"""Floods of requests and messages to the installed localizer: all are answered, its memory is bounded, it serves on."""

from __future__ import annotations

import re
import time
from pathlib import Path

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from gsfeatloc_interfaces.srv import LocalizeImage
from node_harness import (
    TIMEOUT,
    Client,
    assert_answer,
    assert_close,
    connected_client,
    odometry,
    running_localizer,
    send_inputs,
    settle,
    stamped,
)
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from std_srvs.srv import Empty, Trigger

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, pose_with_covariance, rgb_image
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.node.qos import REQUESTS
from gsfeatloc_ros.ros_io.settings import RequestSettings
from gsfeatloc_ros.simulate import SimulatedPhoto

COUNT = 500
# Seconds in which `busy` is told at once, on a slow machine, on which so many requests take a while to be sent.
AT_ONCE = 5.0
# Megabytes.
MAX_GROWTH = 60


@pytest.fixture(scope="module")
def localizer(room_map_file):
    with running_localizer(map__path=room_map_file, track=True, base_frame="camera_optical") as process:
        yield process


@pytest.fixture
def client(localizer, room_camera, photo):
    """One that has been served: what is taken once has been taken."""
    with connected_client() as client:
        send_inputs(client, room_camera, photo)
        assert_answer(client, photo)
        before = megabytes(localizer.pid)
        yield client
        # Whatever came in between.
        send_inputs(client, room_camera, photo)
        assert_answer(client, photo)
        assert megabytes(localizer.pid) - before < MAX_GROWTH
        assert "Traceback" not in localizer.output


def megabytes(pid: int) -> int:
    """Resident memory of a process."""
    return int(re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())[1]) // 1024


def flood(client: Client, kind: type, name: str, request: object, count: int = COUNT) -> list[tuple[object, float]]:
    """The answers to so many requests that do not wait for each other, with the seconds that each took."""
    # One that keeps all answers that it has not taken yet.
    service = client.node.create_client(kind, name, qos_profile=REQUESTS)
    assert client.spin_until(service.service_is_ready)
    settle(client)
    answers: list[tuple[object, float]] = []
    for _ in range(count):
        sent = time.monotonic()
        future = service.call_async(request)
        future.add_done_callback(lambda future, sent=sent: answers.append((future.result(), time.monotonic() - sent)))
        client.spin_once(0.0)
    assert client.spin_until(lambda: len(answers) == count, TIMEOUT), f"{len(answers)} of {count} answers"
    client.node.destroy_client(service)
    return answers


def localize_image_request(camera: Camera, photo: SimulatedPhoto) -> LocalizeImage.Request:
    image, prior = rgb_image(photo.image), pose_with_covariance(photo.T_map_camera_prior)
    return LocalizeImage.Request(image=image, camera_info=camera_info_of(camera), has_prior=True, prior=prior)


def test_of_many_who_ask_at_once_few_wait_and_the_others_are_told_at_once(client, photo):
    """They would all share one answer; but whoever can ask can ask for as many as that."""
    answers = flood(client, Trigger, "localizer/relocalize", Trigger.Request())
    busy = [seconds for answer, seconds in answers if answer.message.startswith("busy: ")]
    assert sum(answer.success for answer, _ in answers) + len(busy) == COUNT
    assert max(busy) < AT_ONCE
    # Beside the one that is worked on, or a few more where that ends meanwhile.
    assert COUNT - len(busy) > RequestSettings.max_waiting
    assert len(busy) > 0.8 * COUNT

    def told() -> bool:
        return any(
            health.level == DiagnosticStatus.WARN and "were not served" in health.reason for health in client.health
        )

    assert client.spin_until(told, TIMEOUT)


def test_images_that_are_sent_at_once_are_localized_or_told_that_it_is_busy(client, room_camera, photo):
    request = localize_image_request(room_camera, photo)
    answers = [answer for answer, _ in flood(client, LocalizeImage, "localizer/localize_image", request, 12)]
    localized = [answer for answer in answers if answer.status == LocalizeImage.Response.LOCALIZED]
    busy = [answer for answer in answers if answer.status == LocalizeImage.Response.BUSY]
    assert len(localized) + len(busy) == len(answers)
    assert len(localized) > RequestSettings.max_waiting
    for answer in localized:
        assert_close(answer.pose, photo.T_map_camera)


def test_what_nobody_waits_for_any_more_is_not_worked_on(client, localizer, room_camera, photo):
    """Whoever asked has left before its turn."""
    request = localize_image_request(room_camera, photo)
    with connected_client() as other:
        service = other.node.create_client(LocalizeImage, "localizer/localize_image", qos_profile=REQUESTS)
        assert other.spin_until(service.service_is_ready)
        settle(other)
        for _ in range(RequestSettings.max_waiting):
            service.call_async(request)
        # Until they have been taken.
        other.call(GetParameters, "localizer/get_parameters", GetParameters.Request())
    localizer.wait_for_output("~/localize_image: busy: whoever asked is gone", TIMEOUT)


RATE = Parameter("max_rate", value=10.0).to_parameter_msg()


@pytest.mark.parametrize(
    ("kind", "name", "request_"),
    [
        (Empty, "reinitialize_global_localization", Empty.Request()),
        (SetParameters, "localizer/set_parameters", SetParameters.Request(parameters=[RATE])),
        (
            SetParametersAtomically,
            "localizer/set_parameters_atomically",
            SetParametersAtomically.Request(parameters=[RATE]),
        ),
        (GetParameters, "localizer/get_parameters", GetParameters.Request(names=["max_rate"] * 100)),
        (ListParameters, "localizer/list_parameters", ListParameters.Request()),
        (DescribeParameters, "localizer/describe_parameters", DescribeParameters.Request(names=["max_rate"] * 50)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_each_of_many_requests_is_answered(client, kind, name, request_):
    assert max(seconds for _, seconds in flood(client, kind, name, request_)) < AT_ONCE


def test_of_many_changes_of_the_map_one_is_made_at_a_time(client, room_map_file):
    path = Parameter("map.path", value=str(room_map_file)).to_parameter_msg()
    answers = flood(client, SetParameters, "localizer/set_parameters", SetParameters.Request(parameters=[path]), 100)
    results = [answer.results[0] for answer, _ in answers]
    assert any(result.successful for result in results)
    assert all(result.successful or "is being loaded: wait for it" in result.reason for result in results)
    assert client.spin_until(lambda: client.set_parameter("map.path", str(room_map_file)).successful, TIMEOUT)
    assert client.spin_until(lambda: client.maps and client.maps[-1].ok, TIMEOUT)


@pytest.mark.parametrize("topic", ["camera_info", "prior", "prior_with_covariance", "initialpose", "odom", "image"])
def test_a_flood_of_messages_does_not_hold_up_what_is_asked(client, room_camera, photo, topic):
    pose = pose_with_covariance(photo.T_map_camera_prior)
    messages = {
        "camera_info": camera_info_of(room_camera),
        "prior": pose_stamped(photo.T_map_camera_prior),
        "prior_with_covariance": pose,
        "initialpose": pose,
        "odom": odometry(np.eye(4), Time(), "camera_optical"),
        "image": rgb_image(photo.image),
    }
    message = messages[topic]
    publisher = client.publisher(topic, type(message))
    get = client.node.create_client(GetParameters, "localizer/get_parameters")
    assert client.spin_until(get.service_is_ready)
    settle(client)
    future, asked, longest, answered = None, 0.0, 0.0, 0
    for number in range(3000 if topic == "image" else 10_000):
        if topic == "odom":
            stamped(message, 1 + number)
        publisher.publish(message)
        client.spin_once(0.0)
        if future is None or future.done():
            answered += future is not None
            longest = max(longest, time.monotonic() - asked) if future else 0.0
            future, asked = get.call_async(GetParameters.Request(names=["max_rate"])), time.monotonic()
    assert client.spin_until(future.done, TIMEOUT)
    assert answered > 10
    assert max(longest, time.monotonic() - asked) < AT_ONCE
