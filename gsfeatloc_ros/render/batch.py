"""Splats of a tile, a batch at a time, in the form in which they are blended, and which of its blocks each touches."""

# Kernels take as many parameters as they need: common/kernels.py says why.

from __future__ import annotations

import math

import numpy as np

from gsfeatloc_ros.common.kernels import njit
from gsfeatloc_ros.common.lanes import (
    LANES,
    SQUARE,
    absolute,
    load_columns,
    mask_bits,
    maximum,
    store,
    store_rows,
)
from gsfeatloc_ros.render import base
from gsfeatloc_ros.render.project import (
    BOTTOM,
    CONIC_X,
    CONIC_Y,
    DEPTH,
    LEFT,
    LOG_OPACITY,
    RIGHT,
    SLANT,
    SPLAT_SIZE,
    TILE,
    TOP,
    X,
    Y,
)

# A bit for each in a word.
BATCH_SIZE = 64
# A batch has a row for each field of a splat up to its depth, and one for the depth's square.
DEPTH2 = DEPTH + 1
BATCH_ROWS = DEPTH + 2
# Lanes are blocks of 4 x 4 pixels: splats are round rather than long, and touch fewer of these than rows of 16.
BLOCKS_X = TILE // SQUARE
BLOCKS = BLOCKS_X * BLOCKS_X

_F, _U = np.float32, np.uint64
_ZERO, _ONE = _F(0), _F(1)
# From a block's middle to its outer pixels; a little more, and a little more alpha, for roundings.
_MIDDLE = _F(0.5 * (SQUARE - 1))
_HALF_BLOCK = _MIDDLE + _F(0.01)
_LOG_MIN_ALPHA = _F(math.log2(base.MIN_ALPHA) - 1e-3)


@njit
def record(key):
    """Return where the record of the splat with this key is."""
    return np.int64(key & np.uint64(0xFFFFFFFF)) * SPLAT_SIZE


@njit
def load_batch(splats, keys, first, x0, y0, nearest, starts, batch, members):
    """Load up to BATCH_SIZE splats, from keys[first] on.

    Args:
        splats, keys: of the tile whose first pixel is x0, y0.
        nearest: depth of the tile's nearest splat, from which depths count.
        starts: (BATCH_SIZE,) int64, to work in.
        batch: flat float32, BATCH_ROWS rows of BATCH_SIZE, written.
        members: (BLOCKS,) uint64, written: for each block, a bit for each splat of the batch that touches it.
    """
    count = min(BATCH_SIZE, len(keys) - first)
    for k in range(count):
        starts[_U(k)] = record(keys[_U(first + k)])
    # The last LANES are filled up with the last splat.
    for k in range(count, -(-count // LANES) * LANES):
        starts[k] = starts[count - 1]
    members[:] = 0
    for group in range(0, count, LANES):
        splat = load_columns(splats, starts, group)
        depth = splat[DEPTH] - nearest
        store_rows(batch, group, BATCH_SIZE, splat[:DEPTH])
        store(batch, DEPTH * BATCH_SIZE + group, depth)
        store(batch, DEPTH2 * BATCH_SIZE + group, depth * depth)
        _find_members(splat, x0, y0, group, members)
    among = _U(0xFFFFFFFFFFFFFFFF) >> _U(BATCH_SIZE - count)
    for block in range(BLOCKS):
        members[block] &= among


@njit
def _find_members(splat, x0, y0, group, members):
    """Set bits, from `group` on, for LANES splats in the word of each block that they may touch.

    Without a branch on what each touches: that cannot be predicted.

    In the block, dy and dx - SLANT dy each come no nearer to 0 than some distance; at both these distances a splat that
    touches it has an alpha of MIN_ALPHA.
    """
    level = splat[LOG_OPACITY] - _LOG_MIN_ALPHA
    half_width = _HALF_BLOCK * (_ONE + absolute(splat[SLANT]))
    for row in range(BLOCKS_X):
        first_y = y0 + _F(SQUARE * row)
        dy = first_y + _MIDDLE - splat[Y]
        gap_y = maximum(absolute(dy) - _HALF_BLOCK, _ZERO)
        level_in_row = level + splat[CONIC_Y] * gap_y * gap_y
        middle = splat[X] + splat[SLANT] * dy
        in_row = (splat[TOP] <= first_y + _F(SQUARE - 1)) & (splat[BOTTOM] >= first_y)
        for column in range(BLOCKS_X):
            first_x = x0 + _F(SQUARE * column)
            gap_x = maximum(absolute(middle - (first_x + _MIDDLE)) - half_width, _ZERO)
            in_column = (splat[LEFT] <= first_x + _F(SQUARE - 1)) & (splat[RIGHT] >= first_x)
            inside = in_row & in_column & (splat[CONIC_X] * gap_x * gap_x + level_in_row >= _ZERO)
            members[row * BLOCKS_X + column] |= _U(mask_bits(inside)) << _U(group)
