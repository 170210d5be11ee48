"""How OpenMP's threads, those of torch and numba, wait for each other."""

from __future__ import annotations

import os


def wait_passively() -> None:
    """Let OpenMP's threads sleep while they wait; where OMP_WAIT_POLICY is set, it stays as it is.

    Call this before torch or numba load OpenMP, which reads it then. Threads that spin instead make every call wait for
    the scheduler on busy cores (measured: XFeat took 1500 ms instead of 50 beside one other busy process).
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
