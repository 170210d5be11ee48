"""The installed localizer is stopped, or told to change its state, at a bad moment; every test runs its own."""

from __future__ import annotations

import signal

import numpy as np
import rclpy
from lifecycle_msgs.srv import ChangeState, GetState
from node_harness import TIMEOUT, Client, assert_answer, connected_client, running_localizer, send_inputs, settle

from gsfeatloc_ros.client.messages import camera_info_of, pose_with_covariance, rgb_image

# A signal in the middle of a localization may take so long to end the node, in seconds, on a slow machine.
END_TIMEOUT = 8.0
# So long a request may wait for its answer.
ANSWER_TIMEOUT = 10.0


def send_good(client: Client, camera, photo) -> None:
    send_inputs(client, camera, photo)
    assert_answer(client, photo)


def test_signal_in_the_middle_of_a_localization(room_map_file, room_camera, room_photos, tmp_path):
    """One of many seconds: without an index all of a wide prior is searched for a photo of nothing in the map."""
    photo = room_photos[0]
    parameters = {"map__path": room_map_file, "localizer__max_views": 1000}
    parameters |= {"index__build": False, "index__path": tmp_path / "none"}
    with running_localizer(**parameters) as localizer, connected_client() as client:
        client.send_camera_info(camera_info_of(room_camera))
        wide = pose_with_covariance(photo.T_map_camera, np.diag([1.0, 1.0, 1.0, 10.0, 10.0, 10.0]))
        client.send_prior(wide)
        mirrored = rgb_image(np.ascontiguousarray(photo.image[:, ::-1]))
        mirrored.header.stamp = client.next_stamp()
        client.send_image(mirrored)
        client.spin(0.5)
        running = client.send_request()
        client.spin(0.5)
        newer = rgb_image(np.ascontiguousarray(photo.image[::-1]))
        newer.header.stamp = client.next_stamp()
        client.send_image(newer)
        client.spin(0.5)
        waiting = client.send_request()
        client.spin(0.5)
        assert not running.done(), running.result()
        assert not waiting.done(), waiting.result()
        localizer.signal(signal.SIGTERM)
        answered = client.spin_until(lambda: running.done() and waiting.done(), END_TIMEOUT)
        assert localizer.wait(END_TIMEOUT) == 0, localizer.output
        assert "Traceback" not in localizer.output
        assert answered, localizer.output
        for request in (running, waiting):
            assert not request.result().success
            assert "the node is stopping" in request.result().message
        assert client.poses == {}


def test_transitions_that_the_state_does_not_allow(room_map_file, room_camera, room_photos):
    photo = room_photos[0]
    with running_localizer(map__path=room_map_file, matcher__name="sift") as localizer, connected_client() as client:
        send_good(client, room_camera, photo)

        def change(number: int, label: str = "") -> bool:
            request = ChangeState.Request()
            request.transition.id, request.transition.label = number, label
            return client.call(ChangeState, "localizer/change_state", request, ANSWER_TIMEOUT).success

        def state() -> str:
            return client.call(GetState, "localizer/get_state", GetState.Request()).current_state.label

        # 4 deactivates, 7 shuts down; all others are those of other states, or of none.
        for number in (0, 1, 2, 3, 5, 6, 8, 10, 11, 12, 20, 30, 50, 60, 99, 255):
            assert not change(number), number
            assert state() == "active", number
        for label in ("configure", "cleanup", "no such transition", "transition_success", "\u6f22"):
            assert not change(0, label), label
            assert state() == "active", label
        assert_answer(client, photo)
        assert change(4)
        assert state() == "inactive"
        assert not change(4)
        assert not change(1)
        assert change(3)
        assert_answer(client, photo)
        assert "Traceback" not in localizer.output


def test_clean_up_while_requests_wait(room_map_file, room_camera, room_photos):
    photo = room_photos[0]
    with running_localizer(map__path=room_map_file, matcher__name="sift") as localizer, connected_client() as client:
        send_good(client, room_camera, photo)
        changer = client.node.create_client(ChangeState, "localizer/change_state")
        assert client.spin_until(changer.service_is_ready)
        settle(client)
        futures = [client.send_request() for _ in range(3)]

        def change(number: int) -> rclpy.Future:
            request = ChangeState.Request()
            request.transition.id = number
            return changer.call_async(request)

        futures += [change(4), change(2)]
        assert client.spin_until(lambda: futures[-1].done() and futures[-2].done(), TIMEOUT), localizer.output
        assert futures[-1].result().success
        assert client.spin_until(lambda: all(future.done() for future in futures), ANSWER_TIMEOUT), localizer.output
        for again in (change(1), change(3)):
            assert client.spin_until(again.done, TIMEOUT), localizer.output
            assert again.result().success
        client.connect()
        send_good(client, room_camera, photo)
        assert "Traceback" not in localizer.output
