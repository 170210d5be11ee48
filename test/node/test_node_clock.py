"""The installed localizer with the clock of a bag, or of a simulation, that starts anew."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from node_harness import assert_answer, assert_no_answer, connected_client, running_localizer, stamped
from rosgraph_msgs.msg import Clock

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image


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
