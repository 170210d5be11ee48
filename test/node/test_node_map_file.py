"""The map of the installed localizer while it runs: its file is spoilt, another one is asked for."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from node_harness import (
    RESEND_PERIOD,
    TIMEOUT,
    Client,
    assert_answer,
    assert_close,
    connected_client,
    running_localizer,
    send_inputs,
)

from gsfeatloc_ros.client.messages import pose_stamped, rgb_image, stamp_of
from gsfeatloc_ros.maps import GaussianMap
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.render.cache import SUFFIX

# Where the moved room lies in the map.
MOVED = np.array([20.0, -10.0, 5.0])


@pytest.fixture(scope="module")
def map_file(room_map_file, tmp_path_factory) -> Path:
    """A copy that may be spoilt."""
    return shutil.copy(room_map_file, tmp_path_factory.mktemp("served") / "served.ply")


@pytest.fixture(scope="module")
def moved_map_file(room_map, tmp_path_factory) -> Path:
    """The room elsewhere, with so much far away from it that it takes seconds to load."""
    gaussian_map = GaussianMap(
        **{
            field.name: np.concatenate([getattr(room_map, field.name)] * 4)
            for field in fields(room_map)
            if isinstance(getattr(room_map, field.name), np.ndarray)
        }
    )
    gaussian_map.means[:] += MOVED
    gaussian_map.means[len(room_map) :] += 1000.0
    path = tmp_path_factory.mktemp("moved") / "moved.ply"
    write_ply(path, gaussian_map)
    return path


@pytest.fixture(scope="module")
def localizer(map_file):
    with running_localizer(map__path=map_file, matcher__name="sift") as process:
        yield process


@pytest.fixture(scope="module")
def connected(localizer):
    with connected_client() as client:
        yield client


@pytest.fixture
def client(connected, localizer, room_camera, photo):
    assert localizer.alive, localizer.output
    send_inputs(connected, room_camera, photo)
    yield connected
    assert "Traceback" not in localizer.output


def send_image(client: Client, photo) -> str:
    """Send an image, and return its stamp."""
    image = rgb_image(photo.image)
    image.header.stamp = client.next_stamp()
    client.send_image(image)
    return stamp_of(image)


def moved(pose: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[:3, 3] += MOVED
    return pose


def assert_map_is_not_taken(client: Client, path: Path | str, serving: Path) -> None:
    """Asked for this map, the localizer says at once or a little later why it stays with the old one."""
    seen = len(client.maps)
    result = client.set_parameter("map.path", str(path))
    if result.successful:
        assert client.spin_until(lambda: len(client.maps) > seen, TIMEOUT), "nothing was said of the map"
        said = client.maps[-1]
        assert said.level == DiagnosticStatus.ERROR
        assert said.reason.startswith(f"the map is still {serving}: ")
        assert str(path) in said.reason
    else:
        assert "map.path" in result.reason
    assert client.parameter("map.path") == str(serving)


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def empty(path: Path) -> None:
    os.truncate(path, 0)


def overwrite(path: Path) -> None:
    """In place, all of it: what has it mapped into memory sees it."""
    size = path.stat().st_size
    with path.open("r+b") as stream:
        # No multiple of the 32 bytes of a Gaussian: otherwise it is a .splat, of which any bytes are one.
        stream.write(np.random.default_rng(0).bytes(size - size % 32 - 1))
        stream.truncate()


def overwrite_values(path: Path) -> None:
    """In place, all but the header."""
    with path.open("r+b") as stream:
        header = stream.read(4096).index(b"end_header\n") + len(b"end_header\n")
        stream.seek(header)
        stream.write(np.random.default_rng(0).bytes(path.stat().st_size - header))


def delete(path: Path) -> None:
    path.unlink()


def put_a_pipe(path: Path) -> None:
    """Of which nobody writes the other end."""
    path.unlink()
    os.mkfifo(path)


SPOILERS = [truncate, empty, overwrite, overwrite_values, delete, put_a_pipe]


def restore(path: Path, room_map_file: Path) -> None:
    path.unlink(missing_ok=True)
    shutil.copy(room_map_file, path)


# Before the others: it runs a localizer of its own.
def test_signal_while_a_map_is_loaded(room_map_file, moved_map_file):
    parameters = {"map__path": room_map_file, "matcher__name": "sift", "map__cache": "false"}
    with running_localizer(**parameters) as localizer, connected_client() as client:
        assert client.set_parameter("map.path", str(moved_map_file)).successful
        localizer.signal(signal.SIGTERM)
        assert localizer.wait(TIMEOUT) == 0, localizer.output
        assert "Traceback" not in localizer.output
        assert "the map is now" not in localizer.output, "it was loaded too fast for this test"


@pytest.mark.parametrize("spoil", SPOILERS)
def test_map_file_is_spoilt_while_in_use(client, map_file, room_map_file, photo, spoil: Callable[[Path], None]):
    restore(map_file, room_map_file)
    cache = map_file.with_name(map_file.name + SUFFIX)
    cache.write_bytes(b"garbage")
    spoil(map_file)
    assert_answer(client, photo)
    assert_map_is_not_taken(client, map_file, map_file)
    assert_answer(client, photo)


@pytest.mark.parametrize("spoil", SPOILERS)
def test_another_map_is_garbage(client, map_file, room_map_file, photo, tmp_path, spoil: Callable[[Path], None]):
    other = shutil.copy(room_map_file, tmp_path / "other.ply")
    spoil(other)
    assert_map_is_not_taken(client, other, map_file)
    assert_answer(client, photo)


@pytest.mark.parametrize(
    "path",
    ["", "/nowhere/room.ply", "/", "/dev/zero", "/proc/self/mem", "\u00e4\u6f22\U0001f600", "too long" * 100],
    ids=lambda path: path[:20],
)
def test_path_of_no_map(client, map_file, photo, path):
    assert_map_is_not_taken(client, path, map_file)
    assert_answer(client, photo)


def test_spoilt_cache_is_not_used(client, map_file, room_map_file, photo):
    restore(map_file, room_map_file)
    cache = map_file.with_name(map_file.name + SUFFIX)
    cache.write_bytes(np.random.default_rng(0).bytes(100_000))
    seen = len(client.maps)
    assert client.set_parameter("map.path", str(map_file)).successful
    assert client.spin_until(lambda: len(client.maps) > seen, TIMEOUT)
    assert client.maps[-1].ok, client.maps[-1]
    assert_answer(client, photo)


def test_another_map_serves_once_it_is_loaded(client, map_file, room_map_file, moved_map_file, photo):
    """Until then the old one does."""
    restore(map_file, room_map_file)
    assert_answer(client, photo)
    seen, answered_meanwhile = len(client.maps), 0
    assert client.set_parameter("map.path", str(moved_map_file)).successful
    assert "is being loaded" in client.set_parameter("map.path", str(map_file)).reason
    while len(client.maps) == seen:
        stamp = send_image(client, photo)
        client.spin_until(lambda stamp=stamp: stamp in client.poses or len(client.maps) > seen, RESEND_PERIOD)
        if stamp in client.poses:
            assert_close(client.poses[stamp], photo.T_map_camera)
            answered_meanwhile += 1
    assert client.maps[-1].ok, client.maps[-1]
    assert answered_meanwhile >= 1
    assert client.parameter("map.path") == str(moved_map_file)
    # The old prior is of nowhere now.
    image = rgb_image(photo.image)
    assert not client.attempt(image).ok
    assert client.pose_of(image) is None
    client.send_prior(pose_stamped(moved(photo.T_map_camera_prior)))
    image = rgb_image(photo.image)
    assert client.attempt(image).ok
    assert_close(client.pose_of(image), moved(photo.T_map_camera))
    # And back.
    seen = len(client.maps)
    assert client.set_parameter("map.path", str(map_file)).successful
    assert client.spin_until(lambda: len(client.maps) > seen, TIMEOUT)
    client.send_prior(pose_stamped(photo.T_map_camera_prior))
    assert_answer(client, photo)
