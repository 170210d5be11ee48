"""The installed localizer and the prepared map that it keeps beside the map."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from node_harness import connected_client, running_localizer

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image


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
