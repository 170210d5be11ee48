"""How kernels write Gaussians into chunks: colours in half precision, and the boxes of chunks."""

# Kernels take as many parameters as they need: common/kernels.py says why.

from __future__ import annotations

import math

import numpy as np

from gsfeatloc_ros.common.kernels import njit
from gsfeatloc_ros.common.lanes import bits_of_float
from gsfeatloc_ros.render.chunks import COV_XX, COV_YY, COV_ZZ, MEAN_X

_MIN_HALF, _MAX_HALF = np.float32(2.0**-14), np.float32(65504)


@njit
def half_bits(value):
    """Return the bits, as an int16, of a float32 rounded to half precision; 0 for what is below its normal numbers.

    With whole numbers, as in lanes.load_halves: not all CPUs have an instruction for it.
    """
    if abs(value) < _MIN_HALF:
        return np.int16(0)
    bits = bits_of_float(np.float32(min(max(value, -_MAX_HALF), _MAX_HALF)))
    magnitude = ((bits & np.uint32(0x7FFFFFFF)) + np.uint32(0x1000)) >> np.uint32(13)
    return np.int16((bits >> np.uint32(16) & np.uint32(0x8000)) | (magnitude - np.uint32(112 << 10)))


@njit
def grow_box(rows, slot, deviations, low, high):
    """Let a box, `low` to `high` (3,), hold a Gaussian in the rows of a chunk up to so many standard deviations."""
    for axis, variance in enumerate((rows[COV_XX, slot], rows[COV_YY, slot], rows[COV_ZZ, slot])):
        mean = rows[MEAN_X + axis, slot]
        # A little more, for the rounding to float32.
        extent = 1.00001 * deviations * math.sqrt(variance) + 1e-6 * abs(mean)
        low[axis] = min(low[axis], np.float32(mean - extent))
        high[axis] = max(high[axis], np.float32(mean + extent))
