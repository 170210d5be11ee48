"""One limit for all threads that compute, and for the cores that those in the background take."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from gsfeatloc_ros.common.threads import Cores

# As in the node: numpy, OpenCV and numba are there before the limit is known, torch and faiss come later, and work is
# done in a thread of its own.
LIMITED = """
import json, threading
import cv2, numba, numpy, scipy.linalg
from gsfeatloc_ros.common.threads import limit_threads
limit_threads(1)
import faiss, torch
from threadpoolctl import threadpool_info
found = {}
def look():
    found.update({pool["filepath"]: pool["num_threads"] for pool in threadpool_info()})
    found.update(cv2=cv2.getNumThreads(), numba=numba.config.NUMBA_NUM_THREADS, torch=torch.get_num_threads())
    found.update(faiss=faiss.omp_get_max_threads())
thread = threading.Thread(target=look)
thread.start()
thread.join()
print(json.dumps(found))
"""


# In how many threads BLAS computes, in a program that makes a renderer after it has imported numpy.
BLAS = """
import contextlib
import numpy, scipy.linalg
from gsfeatloc_ros.render import create_renderer
with contextlib.suppress(ValueError):
    create_renderer(None, device="none")
from threadpoolctl import threadpool_info
print({pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"})
"""


def printed(script: str, **environment: str) -> str:
    """Return what a process prints, in an environment that limits no other threads."""
    others = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    command, environment = [sys.executable, "-c", script], others | environment
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=True, env=environment)
    return done.stdout


@pytest.mark.parametrize("count", [1, 2])
def test_the_limit_holds_for_all_libraries(count):
    found = json.loads(printed(LIMITED.replace("limit_threads(1)", f"limit_threads({count})")))
    assert {"cv2", "numba", "torch", "faiss"} < set(found)
    # Those with threads of their own: that of faiss has OpenMP's.
    blas = {name: found.pop(name) for name in list(found) if "openblas" in name and "openblaso" not in name}
    assert blas
    assert set(blas.values()) == {1}
    assert set(found.values()) == {count}, found


def test_blas_computes_in_one_thread_from_the_first_renderer_on_unless_the_user_says_otherwise():
    assert printed(BLAS) == "{1}\n"
    assert printed(BLAS, OPENBLAS_NUM_THREADS="2") == "{2}\n"


def cores_of_threads():
    """The cores on which each thread of this process may run."""
    return [os.sched_getaffinity(int(thread)) for thread in os.listdir("/proc/self/task")]


@contextmanager
def busy_thread():
    """A thread that works all the time, and lets others do so too."""
    ended = threading.Event()

    def work():
        data = bytes(10_000_000)
        while not ended.is_set():
            hashlib.sha256(data).digest()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield thread
    finally:
        ended.set()
        thread.join()


needs_two_cores = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="there is one core")


@needs_two_cores
def test_work_in_the_background_shares_the_cores():
    cores, used = Cores(1), []

    def background():
        with cores.in_background(), cores.in_background():
            found = cores_of_threads()
            assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) > 0
            assert len(set(map(frozenset, found))) == 1
            assert len(found[0]) == 1
            with busy_thread():
                start, work = time.monotonic(), time.process_time()
                while time.monotonic() < start + 0.5:
                    hashlib.sha256(bytes(1_000_000)).digest()
                used.append((time.process_time() - work) / (time.monotonic() - start))

    with busy_thread():
        run_in_thread(background)
        assert used[0] < 1.1
        assert set(map(frozenset, cores_of_threads())) == {frozenset(os.sched_getaffinity(0))}


@pytest.mark.parametrize("count", [0, 100_000])
def test_without_a_limit_all_is_left_to_the_kernel(count):
    def background():
        with Cores(count).in_background():
            thread = threading.get_native_id()
            assert os.getpriority(os.PRIO_PROCESS, thread) == os.getpriority(os.PRIO_PROCESS, os.getpid())
            assert set(map(frozenset, cores_of_threads())) == {frozenset(os.sched_getaffinity(os.getpid()))}

    run_in_thread(background)


def run_in_thread(work):
    """Run it in a thread of its own, which ends nicer than it began; raise what it raises."""
    with ThreadPoolExecutor(1) as pool:
        pool.submit(work).result()
