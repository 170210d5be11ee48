"""numba as all kernels import it: with a place to keep what it compiles, set before the first of them.

Kernels and intrinsics are not typed: what numba makes of them takes types of its own. Nor do they keep to five
parameters: numba passes arrays and numbers at no cost, and objects of Python not at all.
"""

from __future__ import annotations

from typing import Any

import numba
from numba.extending import intrinsic as _intrinsic

from gsfeatloc_ros.common.kernel_cache import set_kernel_cache

set_kernel_cache()
# In case numba was imported before, by others.
numba.config.reload_config()

njit: Any = numba.njit
prange: Any = numba.prange
intrinsic: Any = _intrinsic


def max_threads() -> int:
    """Return how many threads numba has for kernels at most."""
    return vars(numba.config)["NUMBA_NUM_THREADS"]


def set_threads(count: int) -> None:
    """Let the kernels that this thread calls run in `count` threads."""
    numba.set_num_threads(count)
