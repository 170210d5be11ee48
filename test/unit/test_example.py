"""examples/localize_one_photo.py, as a newcomer runs it."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_maps import random_map

from gsfeatloc_ros.common.geometry import so3_exp
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.simulate.room_camera import RoomCamera

EXAMPLE = Path(__file__).parents[2] / "examples/localize_one_photo.py"
PHOTO = np.zeros((480, 640, 3), np.uint8)


def run(map_file: Path, photo_file: Path) -> subprocess.CompletedProcess:
    command = [sys.executable, EXAMPLE, map_file, photo_file]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=EXAMPLE.parents[1])


@pytest.mark.slow
def test_a_photo_of_the_demos_room_is_localized(room, room_map_file, tmp_path):
    example = runpy.run_path(str(EXAMPLE))
    pose = example["PRIOR"].copy()
    pose[:3, :3] @= so3_exp(np.radians([3.0, -8.0, 2.0]))
    pose[:3, 3] += [0.2, -0.1, 0.1]
    photo = RoomCamera(room, example["CAMERA"]).photo(lambda time: pose, 0.0, np.random.default_rng(0))
    cv2.imwrite(str(tmp_path / "photo.png"), photo[:, :, ::-1])
    done = run(room_map_file, tmp_path / "photo.png")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("localized: ")
    printed = np.fromstring(done.stdout.split("\n", 1)[1].split("standard")[0].translate({91: 32, 93: 32}), sep=" ")
    np.testing.assert_allclose(printed.reshape(4, 4), pose, atol=0.02)


@pytest.mark.parametrize(
    ("photo", "said"),
    [
        (PHOTO[:400, :500], "640x480"),
        (None, "photo.png: is missing"),
        (b"", "photo.png: is no JPEG or PNG"),
        (b"no picture", "photo.png: is no JPEG or PNG"),
    ],
)
def test_a_photo_that_cannot_be_used_is_named_in_one_line_with_status_2(photo, said, tmp_path):
    write_ply(tmp_path / "map.ply", random_map(50, 0, seed=0))
    if isinstance(photo, np.ndarray):
        cv2.imwrite(str(tmp_path / "photo.png"), photo)
    elif photo is not None:
        (tmp_path / "photo.png").write_bytes(photo)
    done = run(tmp_path / "map.ply", tmp_path / "photo.png")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("localize_one_photo: ")
    assert said in line


def test_a_map_that_is_none_is_named_too(tmp_path):
    cv2.imwrite(str(tmp_path / "photo.png"), PHOTO)
    done = run(tmp_path / "nowhere.ply", tmp_path / "photo.png")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "nowhere.ply" in done.stderr
