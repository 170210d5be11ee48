"""The loop of common/shrink.py: sixteen rows lie side by side in the processor's vectors, and are made shorter."""

# Kernels take as many parameters as they need: common/kernels.py says why.

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.kernels import njit
from gsfeatloc_ros.common.lanes import LANES, broadcast, load, load_bytes, load_columns, store, store_rows

# Added to a number up to 2^22, what comes out has no bits left for less than 1: that rounds it, halves to even numbers.
_TO_WHOLE = np.float32(1.5 * 2**23)


@njit(cache=True, nogil=True)
def shrink(picture, channels, top, down, left, across, made):
    """Fill in a picture (h, w C) from a larger one (H, W C), by shares `down` of rows from `top` on, and `across`."""
    flat, size = picture.ravel(), picture.shape[1]
    shorter = made.shape[1]
    rows = np.empty(LANES * size, np.float32)
    columns = np.empty(size * LANES, np.float32)
    shorter_columns = np.empty(shorter * LANES, np.float32)
    shorter_rows = np.empty(LANES * shorter, np.float32)
    starts = np.empty(LANES, np.int64)
    for first in range(0, len(made), LANES):
        for row in range(LANES):
            _add_rows(flat, size, top, down, min(first + row, len(made) - 1), rows, row * size)
        _turn(rows, size, starts, columns)
        for pixel in range(len(left)):
            for channel in range(channels):
                mean = broadcast(np.float32(0))
                for k in range(across.shape[1]):
                    place = (left[pixel] + k) * channels + channel
                    mean = mean + load(columns, place * LANES) * across[pixel, k]
                rounded = (mean + _TO_WHOLE) - _TO_WHOLE
                store(shorter_columns, (pixel * channels + channel) * LANES, rounded)
        _turn_back(shorter_columns, shorter, starts, shorter_rows)
        for row in range(min(LANES, len(made) - first)):
            for x in range(shorter):
                made[first + row, x] = np.uint8(shorter_rows[row * shorter + x])


@njit(cache=True, nogil=True)
def _add_rows(flat, size, top, down, row, rows, at):
    """Fill in, from `at` on, the mean of those rows of a flat picture that a row of the smaller one covers."""
    for start in range(0, size, LANES):
        # The last lanes overlap with those before.
        x = min(start, size - LANES)
        mean = broadcast(np.float32(0))
        for k in range(down.shape[1]):
            mean = mean + load_bytes(flat, (top[row] + k) * size + x) * down[row, k]
        store(rows, at + x, mean)


@njit(cache=True, nogil=True)
def _turn(rows, size, starts, columns):
    """Fill in columns (size, LANES) from rows (LANES, size), both flat; `starts` (LANES,) int64 is to work in."""
    for start in range(0, size, LANES):
        x = min(start, size - LANES)
        for row in range(LANES):
            starts[row] = row * size + x
        store_rows(columns, x * LANES, LANES, load_columns(rows, starts, 0))


@njit(cache=True, nogil=True)
def _turn_back(columns, size, starts, rows):
    """Fill in rows (LANES, size) from columns (size, LANES)."""
    for start in range(0, size, LANES):
        x = min(start, size - LANES)
        for column in range(LANES):
            starts[column] = (x + column) * LANES
        store_rows(rows, x, size, load_columns(columns, starts, 0))
