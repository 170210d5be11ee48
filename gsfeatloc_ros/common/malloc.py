"""What the C library (glibc) keeps of memory that was freed."""

from __future__ import annotations

import ctypes
import os

# Of mallopt(3), by what the environment calls them: the number of the option, and its value.
_OPTIONS = {
    # Each thread that allocates would get a place of its own to keep memory in, up to eight for each core.
    "MALLOC_ARENA_MAX": (-8, 2),
    # The pictures of a localization take 10 to 30 MB in all.
    "MALLOC_TRIM_THRESHOLD_": (-1, 32 * 2**20),
    # Each at most 4 MB: what is larger, as images of 1080p, of which requests may bring many, goes back at once.
    "MALLOC_MMAP_THRESHOLD_": (-3, 4 * 2**20),
}


def tune_malloc() -> None:
    """Let the memory of pictures that are gone be kept for the next ones, and no more than that.

    Given back to the system it would come anew page by page, each of them zeroed: that took 4 ms of a localization of
    56, and 10 of one of 95. Kept for each thread apart, as is usual, a flood of requests left 200 MB. To be called
    before there are threads. Where the environment says anything of it, all stays as it is.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt and not os.environ.keys() & {"GLIBC_TUNABLES", *_OPTIONS}:
        for option, value in _OPTIONS.values():
            mallopt(option, value)


def give_back_memory() -> None:
    """Give the system what was freed between what is still used: of a flood of requests, of maps that were loaded."""
    malloc_trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if malloc_trim:
        malloc_trim(0)
