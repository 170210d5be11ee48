"""The installed localizer keeps to `cpu.threads` cores whatever it does, by the CPU time that /proc tells; alone."""

from __future__ import annotations

import time

import numpy as np
import pytest
from camera_process import running_camera
from node_harness import connected_client, running_localizer, send_inputs
from sensor_msgs.msg import PointCloud2

from gsfeatloc_ros.client.observer import Sample
from gsfeatloc_ros.client.process import START_TIMEOUT

# Seconds over which the time is counted, and most cores that may be taken meanwhile.
SECONDS = 5.0
MOST = 1.1


def cores(process, client, act=lambda: None):
    """How many cores' time the localizer takes while something is done again and again."""
    start, before = time.monotonic(), Sample.of(process.pid, 0.0)
    while time.monotonic() < start + SECONDS:
        act()
        client.spin(0.2)
    return (Sample.of(process.pid, 0.0).cpu - before.cpu) / (time.monotonic() - start)


@pytest.mark.nightly
@pytest.mark.parametrize("matcher", ["sift", "xfeat"])
def test_one_core_is_enough_whatever_it_does(room_map_file, room_camera, photo, tmp_path, matcher):
    np.save(tmp_path / "picture.npy", photo.image)
    parameters = {
        "map__path": room_map_file,
        "matcher__name": matcher,
        "cpu__threads": 1,
        "index__build": True,
        "index__path": tmp_path / "room.index",
        "index__views": 5000,
    }
    taken = {}
    with running_localizer(**parameters) as process, connected_client() as client:
        process.wait_for_output(r"building the view index: looked from \d+ of \d+ places", START_TIMEOUT)
        taken["index"] = cores(process, client)
        send_inputs(client, room_camera, photo)
        with running_camera(tmp_path / "picture.npy"):
            assert client.spin_until(lambda: bool(client.poses))
            taken["index and images"] = cores(process, client)

            def change() -> None:
                # One that is asked for while another is loaded is refused.
                client.set_parameter("map.path", str(room_map_file))

            taken["maps and images"] = cores(process, client, change)
            clouds = client.listen(PointCloud2, "localizer/map")
            taken["maps, ~/map and images"] = cores(process, client, change)
            assert clouds
            assert "the map is now" in process.output
        taken["nothing asked"] = cores(process, client)
    assert max(taken.values()) <= MOST, taken
