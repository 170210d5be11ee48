"""The installed localizer with a socket in systemd's place: it says that it is ready, that it lives, that it ends."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from node_harness import RESEND_PERIOD, TIMEOUT, NodeProcess, connected_client, node_arguments

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped

# Seconds of silence after which systemd would end it; a slow machine may hold it up for some.
WATCHDOG = 8.0
# Seconds between two beats are a quarter of that: here one was left out.
SILENCE = 3.0


class Listener:
    """What a service says, with the times at which it did."""

    def __init__(self, path: Path) -> None:
        self.environment = {"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": str(int(1e6 * WATCHDOG))}
        self.said: list[tuple[str, float]] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def words(self) -> list[str]:
        """All but the beats."""
        return [word for word, _ in self.said if word != "WATCHDOG=1"]

    def wait_for(self, word: str) -> None:
        deadline = time.monotonic() + TIMEOUT
        while word not in self.words():
            assert time.monotonic() < deadline, self.said
            time.sleep(0.02)

    def silence(self) -> float:
        """Seconds since it last said anything."""
        return time.monotonic() - self.said[-1][1]

    def longest_silence(self) -> float:
        """Seconds between two words."""
        times = [moment for _, moment in self.said]
        return max(np.diff(times), default=0.0)

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stream:
            stream.sendto(b"", self.environment["NOTIFY_SOCKET"])
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        while word := self._socket.recv(100).decode():
            self.said.append((word, time.monotonic()))


@contextmanager
def listener(folder: Path) -> Iterator[Listener]:
    listening = Listener(folder / "notify")
    try:
        yield listening
    finally:
        listening.close()


def test_from_the_first_to_the_last(room_map_file, tmp_path):
    with listener(tmp_path) as systemd:
        process = NodeProcess(*node_arguments(map__path=room_map_file), environment=systemd.environment)
        try:
            process.wait_until_ready()
            systemd.wait_for("READY=1")
            beats = len(systemd.said)
            time.sleep(WATCHDOG)
            assert len(systemd.said) - beats >= 2
            process.signal(signal.SIGTERM)
            assert process.wait() == 0, process.output
        finally:
            process.end()
        assert systemd.words() == ["READY=1", "STOPPING=1"]
        assert systemd.longest_silence() < WATCHDOG
        assert "systemd cannot be told" not in process.output


def test_a_start_that_fails_is_never_ready(tmp_path):
    with listener(tmp_path) as systemd:
        process = NodeProcess(*node_arguments(map__path=tmp_path / "none.ply"), environment=systemd.environment)
        assert process.wait() == 1
        process.end()
        assert systemd.words() == []


# As its executable, but for how long a localization may be silent, and that each is, as one that hangs in native code.
HANGING = """
import sys
import time
from gsfeatloc_ros.node import attempts, localizer_node, main
attempts.Attempts._attempt = lambda *arguments: time.sleep(1000)
localizer_node._MAX_SILENCE = 0.2
sys.exit(main.main())
"""


def test_of_a_localization_that_hangs_no_beat_tells(room_map_file, room_camera, photo, tmp_path):
    arguments = node_arguments(map__path=room_map_file)
    with listener(tmp_path) as systemd:
        command = [sys.executable, "-c", HANGING, *arguments]
        process = subprocess.Popen(command, env={**os.environ, **systemd.environment})
        try:
            systemd.wait_for("READY=1")
            with connected_client() as client:
                client.send_camera_info(camera_info_of(room_camera))
                client.send_prior(pose_stamped(photo.T_map_camera_prior))
                # Best effort may lose an image.
                for _ in range(10):
                    client.send_once(photo.image)
                    if client.spin_until(lambda: systemd.silence() > SILENCE, 2 * RESEND_PERIOD):
                        break
                assert systemd.silence() > SILENCE
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(TIMEOUT) == 0
