"""numba as all kernels import it: with a place to keep what it compiles, set before the first of them.

Kernels and intrinsics are not typed: what numba makes of them takes types of its own. Nor do they keep to five
parameters: numba passes arrays and numbers at no cost, and objects of Python not at all.
"""

from __future__ import annotations

import functools
import logging
from typing import Any

import numba
from numba.core.caching import FunctionCache
from numba.extending import intrinsic as _intrinsic

from gsfeatloc_ros.common.kernel_cache import kernel_cache_folder, set_kernel_cache

_log = logging.getLogger(__name__)

set_kernel_cache()
# In case numba was imported before, by others.
numba.config.reload_config()

prange: Any = numba.prange
intrinsic: Any = _intrinsic


class _KernelCache(FunctionCache):
    """Where a kernel is kept, if it can be: on a full disk numba's own ends the call that compiled it."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except OSError as error:
            _say(str(error))
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _say(str(error))


def _njit(function: Any = None, **options: Any) -> Any:
    """Compile a function as numba.njit does, but for this run only where what was compiled cannot be kept."""
    if function is None:
        return functools.partial(_njit, **options)
    kernel = numba.njit(**options)(function)
    if options.get("cache"):
        kernel._cache = _KernelCache(function)
    return kernel


# Not typed: see above.
njit: Any = _njit


@functools.cache
def _say(reason: str) -> None:
    """Log that kernels cannot be kept; once, not for each of them."""
    _log.warning("compiled kernels are for this run only, %s cannot be used: %s", kernel_cache_folder(), reason)


def max_threads() -> int:
    """Return how many threads numba has for kernels at most."""
    return vars(numba.config)["NUMBA_NUM_THREADS"]


def set_threads(count: int) -> None:
    """Let the kernels that this thread calls run in `count` threads."""
    numba.set_num_threads(count)
