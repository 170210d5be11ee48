"""The installed localizer on a full disk: it starts, localizes, and says what it cannot keep."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from node_harness import TIMEOUT, NodeProcess, assert_answer, connected_client, node_arguments, send_inputs


@pytest.fixture
def full_disk(room_map_file, tmp_path) -> Iterator[Path]:
    """With the map of the room and no room for anything else."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("only root can make a disk that is full")
    try:
        shutil.copy(room_map_file, disk)
        (disk / "log").mkdir()
        # Until there is none for a single byte more.
        with (disk / "filling").open("wb", buffering=0) as stream, suppress(OSError):
            while True:
                assert stream.write(bytes(2**16))
        yield disk
    finally:
        subprocess.run(["umount", disk], check=True)


@pytest.mark.parametrize("kernels", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_it_serves_and_says_what_it_cannot_keep(full_disk, room_map_file, room_camera, photo, kernels):
    """With kernels that cannot be kept either all of them are compiled, which takes a minute."""
    arguments = node_arguments(
        map__path=full_disk / room_map_file.name,
        track=True,
        base_frame="camera_optical",
        state__path=full_disk / "pose.json",
        index__build=True,
        index__path=full_disk / "room.index",
    )
    environment = {"ROS_LOG_DIR": str(full_disk / "log")}
    if kernels:
        environment["NUMBA_CACHE_DIR"] = str(full_disk / "kernels")
    localizer = NodeProcess(*arguments, environment=environment)
    try:
        localizer.wait_for_index()
        with connected_client() as client:
            send_inputs(client, room_camera, photo)
            assert_answer(client, photo)
            localizer.wait_for_output(r"state\.path: the pose cannot be saved: .*No space left on device", TIMEOUT)
            localizer.wait_for_output(r"room\.index: cannot be written, the index is made again next time: No space")
            if kernels:
                localizer.wait_for_output("compiled kernels are for this run only, .*: .*No space left on device")
            assert_answer(client, photo)
        assert "Traceback" not in localizer.output
    finally:
        localizer.end()
    assert {path.name for path in full_disk.iterdir()} <= {room_map_file.name, "filling", "log", "kernels"}
