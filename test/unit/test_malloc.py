"""What the C library keeps of memory that was freed, from the first renderer on."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import gsfeatloc_ros

START = """
import contextlib, ctypes, resource, threading
import numpy as np
from gsfeatloc_ros.render import create_renderer
with contextlib.suppress(ValueError):
    create_renderer(None, device="none")
"""
# Pictures of localizations, made and dropped again and again in a thread, as the node's worker does; prints how many
# pages were taken from the system for it.
PICTURES = """
def localize():
    pictures = [np.ones((480, 640), np.float32) for _ in range(16)]
def work():
    localize()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        localize()
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
thread = threading.Thread(target=work)
thread.start()
thread.join()
"""
# Threads that allocate at the same time; prints in how many places memory is kept.
THREADS = """
libc = ctypes.CDLL(None)
libc.fopen.restype = ctypes.c_void_p
together = threading.Barrier(12)
def allocate():
    together.wait()
    kept = bytearray(1000)
    together.wait()
threads = [threading.Thread(target=allocate) for _ in range(12)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
stream = libc.fopen(b"/dev/stdout", b"w")
libc.malloc_info(0, ctypes.c_void_p(stream))
libc.fflush(None)
"""

# Every other one of many small pieces is freed; prints what part of the memory is held then, and once it is given back.
PIECES = """
from gsfeatloc_ros.common.malloc import give_back_memory
def resident():
    return int(open("/proc/self/statm").read().split()[1])
before = resident()
pieces = [bytes(200_000) for _ in range(1000)]
most = resident() - before
pieces[::2] = [b""] * 500
freed = resident() - before
give_back_memory()
print(freed / most, (resident() - before) / most)
"""

environments = pytest.mark.parametrize(
    ("chosen", "tuned"),
    [({}, True), ({"MALLOC_TRIM_THRESHOLD_": "0"}, False), ({"MALLOC_MMAP_THRESHOLD_": "1"}, False)],
)


def printed(script: str, chosen: dict[str, str]) -> str:
    """Return what a process prints that makes a renderer first, in an environment that says no more of malloc."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    package = Path(gsfeatloc_ros.__file__).parents[1]
    command, environment = [sys.executable, "-c", START + script], environment | chosen
    return subprocess.run(command, cwd=package, env=environment, capture_output=True, text=True, check=True).stdout


@environments
def test_freed_pictures_are_kept_unless_the_user_says_otherwise(chosen, tuned):
    # 10 times 16 pictures are 48,000 pages.
    assert (int(printed(PICTURES, chosen)) < 500) == tuned


@environments
def test_they_are_kept_once_and_not_for_each_thread(chosen, tuned):
    assert (printed(THREADS, chosen).count("<heap nr=") <= 2) == tuned


def test_what_was_freed_between_what_is_used_is_given_back():
    freed, given_back = map(float, printed(PIECES, {}).split())
    assert freed > 0.9
    assert given_back < 0.6
