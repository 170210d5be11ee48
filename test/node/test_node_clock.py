"""The installed localizer with the clock of a bag, or of a simulation, that starts anew."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from gsfeatloc_interfaces.srv import LocalizeImage
from node_harness import (
    assert_answer,
    assert_close,
    assert_no_answer,
    connected_client,
    running_localizer,
    settle,
    stamped,
)
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, pose_with_covariance, rgb_image
from gsfeatloc_ros.node.qos import REQUESTS

# Seconds in which requests are answered, by the parameters requests.timeout and search.max_seconds.
ANSWER_TIMEOUT = 13.0


def test_clock_jumps_back(room_map_file, room_camera, room_photos):
    photo = room_photos[0]
    parameters = {"map__path": room_map_file, "matcher__name": "sift", "use_sim_time": "true"}
    with running_localizer(**parameters) as localizer, connected_client() as client:
        prior = pose_stamped(photo.T_map_camera_prior)
        client.publish("/clock", Clock(clock=Time(sec=1000)))
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(stamped(prior, 1000))
        assert_answer(client, photo, 1001)
        client.publish("/clock", Clock(clock=Time(sec=1002, nanosec=250_000_000)))
        # The time of the simulation counts.
        assert client.attempt_as_stamped(stamped(rgb_image(photo.image), 1002)).values["latency_ms"] == "250.0"
        assert client.spin_until(lambda: any("-375.0" in d.values["latency_ms_median"] for d in client.health))
        client.publish("/clock", Clock(clock=Time(sec=900)))
        localizer.wait_for_output(r"time went back by 102\.2 s: what is stamped later is forgotten")
        assert client.attempt_as_stamped(stamped(rgb_image(photo.image), 901)).values["prior"] == "none"
        client.send_prior(stamped(prior, 900))
        assert_answer(client, photo, 903)
        # What was still on its way.
        client.send_prior(stamped(prior, 1000))
        assert_no_answer(client, rgb_image(photo.image), r"prior is 96\.0 s newer than the image .*prior_max_age", 904)
        client.publish("/clock", Clock(clock=Time(sec=0)))
        localizer.wait_for_output(r"time went back by 900\.0 s")
        assert client.attempt_as_stamped(stamped(rgb_image(photo.image), 1)).values["prior"] == "none"
        client.send_prior(stamped(prior, 1))
        assert_answer(client, photo, 2)
        assert "Traceback" not in localizer.output


def test_clock_jumps_back_while_requests_wait(room_map_file, room_camera, room_photos):
    """They are answered all the same, in time, by a pose or by why there is none."""
    photo = room_photos[0]
    parameters = {"map__path": room_map_file, "matcher__name": "sift", "use_sim_time": "true"}
    with running_localizer(**parameters) as localizer, connected_client() as client:
        client.publish("/clock", Clock(clock=Time(sec=1000)))
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(stamped(pose_stamped(photo.T_map_camera_prior), 1000))
        assert_answer(client, photo, 1001)
        request = LocalizeImage.Request(image=rgb_image(photo.image), camera_info=camera_info_of(room_camera))
        request.has_prior, request.prior = True, pose_with_covariance(photo.T_map_camera_prior)
        service = client.node.create_client(LocalizeImage, "localizer/localize_image", qos_profile=REQUESTS)
        assert client.spin_until(service.service_is_ready)
        settle(client)
        clock = client.publisher("/clock", Clock)
        answers = []
        for seconds in (1000, 10, 5000, 0):
            answers += [service.call_async(request), client.send_request()]
            clock.publish(Clock(clock=Time(sec=seconds)))
            client.spin(0.05)
        assert client.spin_until(lambda: all(answer.done() for answer in answers), ANSWER_TIMEOUT), localizer.output
        for answer in (future.result() for future in answers):
            if isinstance(answer, Trigger.Response):
                assert answer.success or answer.message
            elif answer.status == LocalizeImage.Response.LOCALIZED:
                assert_close(answer.pose, photo.T_map_camera)
            else:
                assert answer.reason
        localizer.wait_for_output("time went back by 990")
        client.send_prior(stamped(pose_stamped(photo.T_map_camera_prior), 1))
        assert_answer(client, photo, 2)
        assert "Traceback" not in localizer.output
