"""How the installed localizer starts and ends; every test runs its own."""

from __future__ import annotations

import signal
import time

import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from node_harness import (
    Client,
    NodeProcess,
    assert_close,
    assert_start_fails,
    connected_client,
    node_arguments,
    running_localizer,
)
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image
from gsfeatloc_ros.client.process import executable


def test_service_says_what_is_missing(room_map_file):
    with running_localizer(map__path=room_map_file, matcher__name="sift"), connected_client() as client:
        answer = client.relocalize()
        assert not answer.success
        assert "no image yet: publish sensor_msgs/Image on /image" in answer.message
        assert "no camera_info yet: publish sensor_msgs/CameraInfo on /camera_info" in answer.message
        # None is needed.
        assert "prior" not in answer.message


def test_answers_from_renders_at_half_the_size(room_map_file, room_camera, room_photos):
    parameters = {"matcher__name": "sift", "renderer__resolution_scale": 0.5, "renderer__sh_degree": 0}
    with running_localizer(map__path=room_map_file, **parameters) as process, connected_client() as client:
        photo = room_photos[0]
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(pose_stamped(photo.T_map_camera_prior))
        message = rgb_image(photo.image)
        answer = client.attempt(message)
        assert answer.ok, f"{answer.reason}\n{process.output}"
        assert_close(client.pose_of(message), photo.T_map_camera)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_while_idle_ends_it_cleanly(room_map_file, number):
    with running_localizer(map__path=room_map_file, matcher__name="sift") as process:
        assert_clean_end(process, number)


def test_signal_while_busy_answers_the_requests_first(room_map_file, room_camera, room_photos):
    with running_localizer(map__path=room_map_file, matcher__name="sift") as process, connected_client() as client:
        photo = room_photos[0]
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(pose_stamped(photo.T_map_camera_prior))
        assert client.attempt(rgb_image(photo.image)).ok
        requests = [client.send_request() for _ in range(3)]
        client.spin(0.2)
        assert_clean_end(process, signal.SIGTERM)
        assert client.spin_until(lambda: all(request.done() for request in requests), 5.0)


@pytest.mark.parametrize(
    ("delay", "number"),
    [
        (0.6, signal.SIGINT),
        (0.6, signal.SIGTERM),
        (1.5, signal.SIGTERM),
        (3.0, signal.SIGINT),
        pytest.param(1.5, signal.SIGINT, marks=pytest.mark.nightly),
        pytest.param(3.0, signal.SIGTERM, marks=pytest.mark.nightly),
    ],
)
def test_signal_during_the_start_ends_it_cleanly(room_map_file, number, delay):
    process = NodeProcess(*node_arguments(map__path=room_map_file, matcher__name="sift"))
    try:
        time.sleep(delay)
        assert_clean_end(process, number)
    finally:
        process.end()


def assert_clean_end(process: NodeProcess, number: signal.Signals, timeout: float = 20.0) -> None:
    process.signal(number)
    assert process.wait(timeout) == 0, process.output
    assert "Traceback" not in process.output


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({}, "map.path is empty"),
        ({"map__path": "/nowhere/room.ply"}, "/nowhere/room.ply"),
        ({"map__path": executable()}, "localizer"),
        ({"matcher__name": "orb", "map__path": "ROOM"}, "'orb' is not one of"),
        ({"renderer__sh_degree": 4, "map__path": "ROOM"}, "renderer.sh_degree"),
    ],
)
def test_start_that_cannot_be_says_why_in_one_line(room_map_file, parameters, says):
    values = {name: room_map_file if value == "ROOM" else value for name, value in parameters.items()}
    assert_start_fails(says, **values)


@pytest.mark.parametrize(
    ("environment", "says"),
    [
        ({"HOME": None, "ROS_LOG_DIR": None, "ROS_HOME": None}, "neither ROS_LOG_DIR nor HOME is set"),
        ({"ROS_LOG_DIR": __file__}, "which is no folder"),
        ({"ROS_DOMAIN_ID": "abc"}, "ROS_DOMAIN_ID is 'abc': set it to a number"),
        ({"NUMBA_NUM_THREADS": "0"}, "NUMBA_NUM_THREADS is '0'"),
        # rclpy's word.
        ({"ROS_LOG_DIR": "/proc/none"}, "Failed to create log directory"),
    ],
)
def test_an_environment_in_which_it_cannot_start_is_said_in_one_line(room_map_file, environment, says):
    assert_start_fails(says, environment, map__path=room_map_file)


def test_what_nobody_foresaw_of_a_start_is_said_in_one_line(room_map_file, tmp_path):
    """That the weights of a network are a text file torch says in six lines."""
    (tmp_path / "weights.pth").write_text("none")
    assert_start_fails("", map__path=room_map_file, matcher__name="xfeat", matcher__weights=tmp_path / "weights.pth")


def test_the_transition_shutdown_ends_the_process(room_map_file):
    with running_localizer(map__path=room_map_file, matcher__name="sift") as process, connected_client() as client:
        assert change(client, Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert process.wait(10.0) == 0, process.output
        assert "Traceback" not in process.output


def state(client: Client) -> int:
    return client.call(GetState, "localizer/get_state", GetState.Request()).current_state.id


def change(client: Client, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return client.call(ChangeState, "localizer/change_state", request, 180.0).success


def test_a_lifecycle_manager_drives_it(room_map_file, room_camera, room_photos):
    photo = room_photos[0]
    process = NodeProcess(*node_arguments(map__path=room_map_file, autostart=False))
    client = Client()
    try:
        assert state(client) == State.PRIMARY_STATE_UNCONFIGURED
        # Twice: what is cleaned up can be configured again.
        for _ in range(2):
            assert change(client, Transition.TRANSITION_CONFIGURE)
            assert state(client) == State.PRIMARY_STATE_INACTIVE
            answer = client.relocalize()
            assert not answer.success
            assert "not active" in answer.message
            assert change(client, Transition.TRANSITION_ACTIVATE)
            client.connect()
            client.send_camera_info(camera_info_of(room_camera))
            client.send_prior(pose_stamped(photo.T_map_camera_prior))
            image = rgb_image(photo.image)
            assert client.attempt(image).ok
            assert_close(client.pose_of(image), photo.T_map_camera)
            assert change(client, Transition.TRANSITION_DEACTIVATE)
            assert not client.is_tried(client.send_once(photo.image), 1.0)
            assert change(client, Transition.TRANSITION_CLEANUP)
            assert state(client) == State.PRIMARY_STATE_UNCONFIGURED
        assert change(client, Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
        assert "Traceback" not in process.output
    finally:
        client.close()
        process.end()


def test_a_map_that_cannot_be_loaded_leaves_it_unconfigured(tmp_path, room_map_file):
    process = NodeProcess(*node_arguments(map__path=tmp_path / "none.ply", autostart=False))
    client = Client()
    try:
        assert not change(client, Transition.TRANSITION_CONFIGURE)
        assert state(client) == State.PRIMARY_STATE_UNCONFIGURED
        process.wait_for_output(r"\[FATAL\].*none.ply")
        assert client.set_parameter("map.path", str(room_map_file)).successful
        assert change(client, Transition.TRANSITION_CONFIGURE)
    finally:
        client.close()
        process.end()


def test_a_publisher_that_does_not_fit_is_told(room_map_file):
    # Reliable is asked for, best effort is offered.
    overrides = {"qos_overrides./image.subscription.reliability": "reliable"}
    with running_localizer(map__path=room_map_file, **overrides) as process:
        client = Client()
        try:
            client.node.create_publisher(Image, "image", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
            process.wait_for_output("a publisher on /image offers another reliability than is asked for")
        finally:
            client.close()
