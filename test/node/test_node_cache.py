"""The installed localizer and the prepared map that it keeps beside the map."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from node_harness import connected_client, running_localizer

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image
from gsfeatloc_ros.client.process import START_TIMEOUT
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.render.chunks import LARGE_MAP


@pytest.fixture
def map_file(room_map_file, tmp_path) -> Path:
    return Path(shutil.copy(room_map_file, tmp_path))


def cache_of(map_path: Path) -> Path:
    return map_path.with_name(map_path.name + ".gsfeatloc-cache")


def test_answers_from_the_cache_are_the_same(map_file, room_camera, room_photos):
    photo = room_photos[0]
    poses = []
    for _ in range(2):
        with running_localizer(map__path=map_file, matcher__name="sift"), connected_client() as client:
            client.send_camera_info(camera_info_of(room_camera))
            client.send_prior(pose_stamped(photo.T_map_camera_prior))
            message = rgb_image(photo.image)
            answer = client.attempt(message)
            assert answer.ok, answer.reason
            poses.append(client.pose_of(message).pose.pose)
        assert cache_of(map_file).is_file()
    assert poses[0] == poses[1]


@pytest.fixture(scope="module")
def large_map_file(room_map, tmp_path_factory) -> Path:
    """The room, and so much far away that the map is a large one."""
    copies = 1 + LARGE_MAP // np.count_nonzero(room_map.opacities > 0.01)
    arrays = {name: getattr(room_map, name) for name in ("means", "scales", "rotations", "opacities", "sh")}
    far = {name: np.concatenate([array] * copies) for name, array in arrays.items()}
    far["means"] = far["means"] + np.repeat(100.0 * np.arange(copies), len(room_map))[:, None] * [1, 1, 0]
    path = tmp_path_factory.mktemp("large") / "large.ply"
    write_ply(path, replace(room_map, **{name: array.astype(np.float32) for name, array in far.items()}))
    return path


def test_a_cache_that_is_cut_short_in_place_ends_nothing(large_map_file, room_camera, room_photos):
    """What is in use is lost with it: images are refused until the map is there again."""
    with running_localizer(map__path=large_map_file, matcher__name="sift") as process, connected_client() as client:
        photo, cache = room_photos[0], cache_of(large_map_file)
        size = cache.stat().st_size
        os.truncate(cache, 5000)
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(pose_stamped(photo.T_map_camera_prior))
        refused = client.attempt(rgb_image(photo.image))
        assert not refused.ok
        assert f"{cache.name}: was cut short: load the map again" in refused.reason
        process.wait_for_output(f"the map is now {large_map_file}", START_TIMEOUT)
        assert cache.stat().st_size == size
        client.send_prior(pose_stamped(photo.T_map_camera_prior))
        answer = client.attempt(rgb_image(photo.image))
        assert answer.ok, answer.reason


def test_damaged_cache_is_one_line_of_the_log(map_file):
    cache_of(map_file).write_bytes(b"not a map")
    with running_localizer(map__path=map_file, matcher__name="sift") as process:
        lines = [line for line in process.output.splitlines() if cache_of(map_file).name in line]
        assert len(lines) == 1, process.output
        assert "is no prepared map" in lines[0]
    assert cache_of(map_file).stat().st_size > 100_000


def test_without_cache_there_is_none(map_file):
    with running_localizer(map__path=map_file, matcher__name="sift", map__cache="false"):
        assert not cache_of(map_file).exists()
