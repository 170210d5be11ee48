"""The installed localizer with the clock of a bag, or of a simulation, that starts anew."""

from __future__ import annotations

import re

from builtin_interfaces.msg import Time
from node_harness import (
    Client,
    Diagnostic,
    assert_close,
    connected_client,
    info_of,
    prior_of,
    rgb_image,
    running_localizer,
    text,
)
from rosgraph_msgs.msg import Clock


def stamped(message, seconds: int):
    message.header.stamp = Time(sec=seconds)
    return message


def attempt_at(client: Client, image, seconds: int) -> Diagnostic:
    """Send an image of this stamp until the localizer has said something on it."""
    stamped(image, seconds)
    return client.until_diagnosed(lambda: client.send_image(image), lambda d: d.values.get("stamp") == text(image))


def assert_answer(client: Client, query, seconds: int | None = None) -> None:
    """An image, with this stamp or a new one, is answered rightly."""
    image = rgb_image(query.image)
    diagnostic = client.attempt(image) if seconds is None else attempt_at(client, image, seconds)
    assert diagnostic.ok, diagnostic
    assert_close(client.pose_of(image), query.T_map_camera)


def assert_no_answer(client: Client, query, says: str, seconds: int | None = None) -> None:
    """An image, with this stamp or a new one, gets no pose, for a reason that matches."""
    image = rgb_image(query.image)
    diagnostic = client.attempt(image) if seconds is None else attempt_at(client, image, seconds)
    assert not diagnostic.ok
    assert re.search(says, diagnostic.reason), diagnostic
    assert client.pose_of(image) is None


def test_clock_jumps_back(room_map_file, room_camera, room_queries):
    query = room_queries[0]
    parameters = {"map__path": room_map_file, "matcher__name": "sift", "use_sim_time": "true"}
    with running_localizer(**parameters) as localizer, connected_client() as client:
        prior = prior_of(query.T_map_camera_prior)
        client.publish("/clock", Clock(clock=Time(sec=1000)))
        client.send_camera_info(info_of(room_camera))
        client.send_prior(stamped(prior, 1000))
        assert_answer(client, query, 1001)
        client.publish("/clock", Clock(clock=Time(sec=900)))
        localizer.wait_for_output(r"time went back by 100\.0 s: what is stamped later is forgotten")
        assert_no_answer(client, query, "time went back: no prior yet: publish .* on /prior", 901)
        client.send_image(stamped(rgb_image(query.image), 902))
        client.spin(0.2)
        assert "time went back: no prior yet" in client.relocalize().message
        client.send_prior(stamped(prior, 900))
        assert_answer(client, query, 903)
        # What was still on its way.
        client.send_prior(stamped(prior, 1000))
        assert_no_answer(client, query, r"prior is 96\.0 s newer than the image .*prior_max_age", 904)
        client.publish("/clock", Clock(clock=Time(sec=0)))
        localizer.wait_for_output(r"time went back by 900\.0 s")
        assert_no_answer(client, query, "time went back: no prior yet", 1)
        client.send_prior(stamped(prior, 1))
        assert_answer(client, query, 2)
        assert "Traceback" not in localizer.output
