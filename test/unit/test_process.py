"""The parts of the executable that need no ROS: its environment, its end, systemd, loading beside the main thread."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from gsfeatloc_ros.node.environment import check_environment
from gsfeatloc_ros.node.loading import GivenUpError, load
from gsfeatloc_ros.node.systemd import Systemd

TIMEOUT = 20.0


def test_an_environment_as_it_should_be(tmp_path):
    check_environment({"HOME": str(tmp_path)})
    check_environment({"ROS_LOG_DIR": str(tmp_path / "new"), "ROS_DOMAIN_ID": "232", "NUMBA_NUM_THREADS": "1"})


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"ROS_DOMAIN_ID": "abc"}, "ROS_DOMAIN_ID is 'abc': set it to a number from 0 to 232"),
        ({"ROS_DOMAIN_ID": "233"}, "ROS_DOMAIN_ID"),
        ({"ROS_DOMAIN_ID": "-1"}, "ROS_DOMAIN_ID"),
        ({"NUMBA_NUM_THREADS": "0"}, "NUMBA_NUM_THREADS is '0': set it"),
        ({"NUMBA_NUM_THREADS": "two"}, "NUMBA_NUM_THREADS"),
        ({"HOME": ""}, "neither ROS_LOG_DIR nor HOME is set"),
        ({"ROS_LOG_DIR": __file__}, "ROS_LOG_DIR is .* which is no folder"),
        ({"HOME": __file__}, "HOME is .* which is no folder"),
    ],
)
def test_an_environment_that_cannot_be(tmp_path, changes, says):
    with pytest.raises(ValueError, match=says):
        check_environment({"HOME": str(tmp_path)} | changes)


def test_systemd_is_told_what_it_asks_for(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(str(tmp_path / "notify"))
        server.settimeout(TIMEOUT)
        systemd = Systemd({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"})
        systemd.ready()
        for _ in range(3):
            systemd.beat()
        time.sleep(0.11)
        systemd.beat()
        systemd.stopping()
        said = [server.recv(100) for _ in range(4)]
        assert said == [b"READY=1", b"WATCHDOG=1", b"WATCHDOG=1", b"STOPPING=1"]


def test_systemd_in_no_folder():
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind("")  # the kernel finds a name
        name = server.getsockname().decode()
        server.settimeout(TIMEOUT)
        Systemd({"NOTIFY_SOCKET": "@" + name[1:]}).ready()
        assert server.recv(100) == b"READY=1"


def test_without_systemd_nothing_happens(capfd):
    systemd = Systemd({})
    systemd.ready()
    systemd.beat()
    assert capfd.readouterr() == ("", "")


def test_where_systemd_cannot_be_told_that_is_said_once(capfd):
    """Otherwise nobody knows why it ends a service that is ready."""
    systemd = Systemd({"NOTIFY_SOCKET": "/nowhere", "WATCHDOG_USEC": "soon"})
    systemd.ready()
    systemd.beat()
    systemd.stopping()
    output, errors = capfd.readouterr()
    assert output == ""
    (line,) = errors.splitlines()
    assert "systemd cannot be told READY=1: NOTIFY_SOCKET is '/nowhere': " in line


def test_a_systemd_that_does_not_listen_does_not_hold_up_the_node(tmp_path, capfd):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(str(tmp_path / "notify"))
        systemd = Systemd({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "4"})
        filled = threading.Event()

        def beat() -> None:
            # More than the kernel keeps for who does not take them.
            while not capfd.readouterr().err:
                systemd.beat()
            filled.set()

        threading.Thread(target=beat, daemon=True).start()
        assert filled.wait(TIMEOUT)
        server.recv(100)
        systemd.beat()


def test_what_is_loaded_is_returned_and_what_is_raised_is_raised():
    assert load(lambda: 5, lambda: True) == 5
    with pytest.raises(ZeroDivisionError):
        load(lambda: 1 // 0, lambda: True)
    # One that is as well what waiting may raise.
    with pytest.raises(TimeoutError, match="its own"):
        load(lambda: (_ for _ in ()).throw(TimeoutError("its own")), lambda: True)


def test_what_hangs_is_given_up():
    hang = threading.Event()
    with pytest.raises(GivenUpError, match=r"longer than 0\.1 s"):
        load(hang.wait, lambda: True, timeout=0.1)
    asked = iter([True, False])
    with pytest.raises(GivenUpError, match="given up"):
        load(hang.wait, lambda: next(asked))
    hang.set()


STOPPING = """
import ctypes, os, sys, time
from gsfeatloc_ros.node import stop
stop._TIMEOUT = 0.5
stopping = stop.Stop()
stopping.in_order = sys.argv[1] != "early"
print("started", flush=True)
if sys.argv[1] == "native":
    for _ in range(2):  # Python's handlers wait for the end of a call into C
        ctypes.CDLL(None).usleep(10_000_000)
while not stopping:
    time.sleep(0.01)
print("in order", flush=True)
if sys.argv[1] == "hangs":
    time.sleep(30)
"""


# A signal that comes while the log is written, and a log that nobody reads any more.
INTERRUPTED = """
import io, sys
from gsfeatloc_ros.node.stop import leave
class Interrupted(io.RawIOBase):
    def writable(self):
        return True
    def write(self, data):
        leave(0)
sys.stdout = io.TextIOWrapper(io.BufferedWriter(Interrupted()))
print("half of a line", flush=True)
"""
UNREAD = """
import os, sys
from gsfeatloc_ros.node.stop import leave
reading, writing = os.pipe()
os.close(reading)
sys.stdout = open(writing, "w")
print("a line")
leave(0)
"""


@pytest.mark.parametrize("script", [INTERRUPTED, UNREAD])
def test_a_log_that_cannot_be_written_does_not_change_how_it_ends(script):
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, timeout=TIMEOUT)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize(
    ("where", "status", "says"),
    [
        ("early", 0, ""),
        ("orderly", 0, "in order"),
        ("hangs", 1, "in order"),
        ("native", 1, ""),
    ],
)
def test_a_signal_ends_the_process_wherever_it_is(where, status, says):
    process = subprocess.Popen([sys.executable, "-c", STOPPING, where], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout.readline() == b"started\n"
    start = time.monotonic()
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=TIMEOUT)
    assert time.monotonic() - start < 8.0
    assert process.returncode == status, errors
    assert output.decode().strip() == says
    # Where it hung.
    assert (b"most recent call first" in errors) == bool(status), errors
