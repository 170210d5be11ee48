"""The threads that compute: how many, and how they wait for each other."""

from __future__ import annotations

import os
import sys


def wait_passively() -> None:
    """Let OpenMP's threads sleep while they wait; where OMP_WAIT_POLICY is set, it stays as it is.

    Call this before torch or numba load OpenMP, which reads it then. Threads that spin instead make every call wait for
    the scheduler on busy cores (measured: XFeat took 1500 ms instead of 50 beside one other busy process).
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def limit_threads(count: int) -> None:
    """Let numba, OpenMP (torch, faiss), OpenCV and BLAS compute in at most `count` threads; 0 leaves all as it is.

    Each has as many, and they work one after the other. Call this before the first kernel runs and before torch or
    faiss are loaded: OpenMP reads the environment then. Processes that this one starts keep to it too.
    """
    if not count:
        return
    variables = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    os.environ.update(dict.fromkeys(variables, str(count)))
    import cv2
    from threadpoolctl import threadpool_limits

    # BLAS came with numpy, before anybody could know.
    threadpool_limits(count)
    cv2.setNumThreads(count)
    if "numba" in sys.modules:
        sys.modules["numba"].config.reload_config()
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(count)
