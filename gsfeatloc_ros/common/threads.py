"""The threads that compute: how many, how they wait for each other, and on how many cores."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# By how much threads in the background are nicer: three quarters of a core are left to one that works all the time.
_NICENESS = 5
_BLAS = "OPENBLAS_NUM_THREADS"


def wait_passively() -> None:
    """Let OpenMP's threads sleep while they wait, and BLAS compute in one: OpenBLAS's threads can only spin.

    Call this before torch or numba load OpenMP, which reads it then. Threads that spin instead make every call wait for
    the scheduler on busy cores (measured: XFeat took 1500 ms instead of 50 beside one other busy process; and a node at
    10 Hz, for the few products of matrices that are large enough, 1.4 cores instead of 0.6). Where OMP_WAIT_POLICY or
    OPENBLAS_NUM_THREADS is set, it stays as it is.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if _BLAS not in os.environ:
        os.environ[_BLAS] = "1"
        if "numpy" in sys.modules:
            from threadpoolctl import threadpool_limits

            # It came with numpy, which read the environment.
            threadpool_limits(1, user_api="blas")


def limit_threads(count: int) -> None:
    """Let numba, OpenMP (torch, faiss) and OpenCV compute in at most `count` threads; 0 leaves all as it is.

    BLAS computes in one then. Each of the others has as many, and they work one after the other. Call this before the
    first kernel runs and before torch or faiss are loaded: OpenMP reads the environment then. Processes that this one
    starts keep to it too.
    """
    if not count:
        return
    variables = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")
    os.environ.update(dict.fromkeys(variables, str(count)) | {_BLAS: "1"})
    import cv2
    from threadpoolctl import threadpool_limits

    # BLAS came with numpy, before anybody could know.
    threadpool_limits({"openmp": count, "blas": 1})
    cv2.setNumThreads(count)
    if "numba" in sys.modules:
        sys.modules["numba"].config.reload_config()
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(count)


class Cores:
    """Keeps this process to as many cores as it may compute in threads, while something works beside what it does.

    What one call computes keeps to its threads, but a thread in the background takes another core. While there is one,
    all threads run on the same cores, and the kernel shares these out; else they are left to it, which finds the cores
    that are free.

    Args:
        count: of cores; 0 for all.
    """

    def __init__(self, count: int) -> None:
        self._count, self._limited = count, 0 < count < len(os.sched_getaffinity(0))
        self._lock = threading.Lock()
        self._users = 0
        self._before: dict[int, set[int]] = {}

    @contextmanager
    def in_background(self) -> Iterator[None]:
        """Work in this thread, and in those that it starts, beside the others: they go first, on the same cores.

        Where there are no more cores than it may take, the kernel alone says who goes first.
        """
        if not self._limited:
            yield
            return
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + _NICENESS)
        with self._lock:
            self._users += 1
            if self._users == 1:
                self._share()
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if not self._users:
                    self._part()

    def _share(self) -> None:
        allowed = os.sched_getaffinity(0)
        # Those on which the threads are that have worked most: where cores differ, the kernel has found the fast ones.
        busiest = sorted(map(_work_and_core, _threads()), reverse=True)
        cores = list(dict.fromkeys([core for _, core in busiest if core in allowed] + sorted(allowed)))
        self._before = {thread: _allowed(thread) for thread in _threads()}
        for thread in _threads():
            _allow(thread, set(cores[: self._count]))

    def _part(self) -> None:
        everywhere = set[int]().union(*self._before.values())
        for thread in _threads():
            _allow(thread, self._before.get(thread, everywhere))


def _threads() -> list[int]:
    """Return the ids of this process's threads."""
    return [int(name) for name in os.listdir("/proc/self/task")]


def _work_and_core(thread: int) -> tuple[int, int]:
    """Return for how many ticks a thread has worked, and the core on which it was last; zeros if it has ended."""
    try:
        fields = Path(f"/proc/self/task/{thread}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0, 0
    return int(fields[11]) + int(fields[12]), int(fields[36])


def _allowed(thread: int) -> set[int]:
    """Return the cores on which a thread may run; none if it has ended."""
    try:
        return os.sched_getaffinity(thread)
    except OSError:
        return set()


def _allow(thread: int, cores: set[int]) -> None:
    """Let a thread run on these cores; it may have ended, or the machine may not allow it."""
    with suppress(OSError):
        os.sched_setaffinity(thread, cores)
