"""Optical flow by the pyramidal method of Lucas and Kanade (1981; Bouguet, 2001), for a few hundred corners.

It finds what OpenCV's calcOpticalFlowPyrLK finds in a fraction of the time: pyramids are kept from one call to the
next, gradients are computed only where corners are, and windows fit the processor's vectors.
"""

from __future__ import annotations

import math
from functools import cached_property

import cv2
import numpy as np

from gsfeatloc_ros.common.kernels import njit
from gsfeatloc_ros.common.lanes import LANES, broadcast, load, store, total

WINDOW = 15
"""Pixels across and down the windows that are compared."""
MAX_LEVEL = 3
"""Levels of the pyramid are 0 to this."""
# Columns in memory of a window with a margin: lanes, which are one more than a window's columns, and the margins.
_STRIDE = LANES + 2
# Of a window, of which there are three: its brightness, and its gradient to the right and down. Its rows are lanes, of
# which the last is not used.
_WINDOW_SIZE = WINDOW * LANES
_HALF = np.float32((WINDOW - 1) / 2)
# Of a level, that of the next smaller one.
_HALF_SIZE = np.float32(0.5)
# A window may stick out wholly, and needs a pixel more for its gradients and another between pixels.
_BORDER = LANES + 2
# Iterations end after so many, with a step no longer than this, or where they turn to and fro.
_MAX_ITERATIONS, _MIN_STEP, _MIN_CHANGE = 20, np.float32(0.03), np.float32(0.01)
# Least eigenvalue of the gradients' mean outer product, in squares of brightness over pixels, of what is followed.
_MIN_EIGENVALUE = np.float32(0.1024)


class Pyramid:
    """A picture (H, W) uint8, its half, quarter and eighth, for `flow`."""

    def __init__(self, picture: np.ndarray) -> None:
        self._picture = picture

    @cached_property
    def levels(self) -> list[np.ndarray]:
        """The levels, (H + 2 border, W + 2 border) float32, continued by their reflections; none less than a window."""
        level, levels = self._picture, []
        for _ in range(MAX_LEVEL + 1):
            bordered = cv2.copyMakeBorder(level, _BORDER, _BORDER, _BORDER, _BORDER, cv2.BORDER_REFLECT_101)
            levels.append(bordered.astype(np.float32))
            level = cv2.pyrDown(level)
            if min(level.shape) <= WINDOW:
                break
        return levels


def flow(here: Pyramid, there: Pyramid, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find where pixels (N, 2) of one picture are in another of the same size.

    Returns:
        (N, 2) float32 pixels, and which of them were found, (N,) bool.

    Raises:
        ValueError: the pictures are of different sizes.
    """
    sizes = here.levels[0].shape, there.levels[0].shape
    if sizes[0] != sizes[1]:
        raise ValueError(f"pictures of different sizes: {sizes[0]} and {sizes[1]} with their borders")
    pixels, levels = np.ascontiguousarray(pixels, np.float32), len(here.levels)
    moved, found = pixels / np.float32(2**levels), np.ones(len(pixels), np.bool_)
    for level in reversed(range(levels)):
        _follow(here.levels[level], there.levels[level], pixels, np.float32(0.5**level), moved, found)
    return moved, found


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(here, there, pixels, size, moved, found):
    """Find where the windows of pixels (N, 2) of a picture are in another, on a level of `size` times its width.

    Args:
        here, there: the level of both.
        pixels, size: as above.
        moved: (N, 2) where they are on the next smaller level; on this one when it is done.
        found: (N,) bool, written: which they are.
    """
    # Kernels below take flat arrays and numbers alone: numba counts who uses an array, which takes longer than they do.
    height, stride = here.shape[0] - 2 * _BORDER, here.shape[1]
    width = stride - 2 * _BORDER
    here, there = here.ravel(), there.ravel()
    patch = np.empty((WINDOW + 2) * _STRIDE, np.float32)
    window = np.empty(3 * _WINDOW_SIZE, np.float32)
    used = np.empty(LANES, np.float32)
    for corner in range(len(pixels)):
        found[corner] = False
        x, y = size * pixels[corner, 0], size * pixels[corner, 1]
        moved[corner, 0] = x + 2 * (moved[corner, 0] - _HALF_SIZE * x)
        moved[corner, 1] = y + 2 * (moved[corner, 1] - _HALF_SIZE * y)
        # Where its window begins.
        x, y = x - _HALF, y - _HALF
        if not _is_inside(x, y, width, height):
            continue
        _cut_out(here, stride, x, y, patch)
        _mark_used(x, width, used)
        top = _whole(y)
        xx, xy, yy = _differentiate(patch, used, max(0, -top), min(WINDOW, height - top), window)
        least = (xx + yy - math.sqrt((xx - yy) ** 2 + 4 * xy**2)) / (2 * WINDOW * WINDOW)
        if least < _MIN_EIGENVALUE:
            continue
        scale = 1 / (xx * yy - xy * xy)
        before_x = before_y = np.float32(0)
        x, y = moved[corner, 0], moved[corner, 1]
        for iteration in range(_MAX_ITERATIONS):
            if not _is_inside(x - _HALF, y - _HALF, width, height):
                break
            off_x, off_y = _mismatch(there, stride, x - _HALF, y - _HALF, window)
            step_x, step_y = scale * (xy * off_y - yy * off_x), scale * (xy * off_x - xx * off_y)
            x, y = np.float32(x + step_x), np.float32(y + step_y)
            if step_x * step_x + step_y * step_y <= _MIN_STEP**2:
                break
            if iteration > 0 and abs(step_x + before_x) < _MIN_CHANGE and abs(step_y + before_y) < _MIN_CHANGE:
                x, y = np.float32(x - step_x / 2), np.float32(y - step_y / 2)
                break
            before_x, before_y = step_x, step_y
        moved[corner, 0], moved[corner, 1] = x, y
        found[corner] = _is_inside(x - _HALF, y - _HALF, width, height)


@njit(cache=True, nogil=True)
def _is_inside(x, y, width, height):
    """Return whether the window that begins at a pixel has a part in a picture of this size."""
    return -WINDOW <= x < width and -WINDOW <= y < height


@njit(cache=True, nogil=True)
def _whole(x):
    """Return a number that is inside of a level's border, rounded down; math.floor is a call."""
    return np.int64(x + _BORDER) - _BORDER


@njit(cache=True, nogil=True)
def _place(stride, x, y):
    """Return where in a level a pixel is, rounded down; and its shares of the pixels after."""
    left, top = _whole(x), _whole(y)
    return (top + _BORDER) * stride + left + _BORDER, np.float32(x - left), np.float32(y - top)


@njit(cache=True, nogil=True)
def _row(level, at, share):
    """Return lanes of a level from `at` on, moved to the right by a share of a pixel."""
    here = load(level, at)
    return here + share * (load(level, at + 1) - here)


@njit(cache=True, nogil=True)
def _cut_out(level, stride, x, y, patch):
    """Fill in the window that begins at a pixel, with a margin of one, between the pixels."""
    begin, right, down = _place(stride, x, y)
    begin -= stride + 1
    for column in (0, _STRIDE - LANES):
        above = _row(level, begin + column, right)
        for row in range(WINDOW + 2):
            below = _row(level, begin + column + (row + 1) * stride, right)
            store(patch, row * _STRIDE + column, above + down * (below - above))
            above = below


@njit(cache=True, nogil=True)
def _mark_used(x, width, used):
    """Fill in 1 for the columns of the window that begins at a column which the picture has, and 0 for the others."""
    left = _whole(x)
    for column in range(LANES):
        used[column] = column < WINDOW and 0 <= left + column < width


@njit(cache=True, nogil=True)
def _differentiate(patch, used, first, end, window):
    """Fill in a window from its patch, with Scharr's gradients; return the sums of their products xx, xy and yy.

    Columns that are not `used`, and rows before the `first` and from the `end` on, have no gradient.
    """
    columns = load(used, 0)
    xx = xy = yy = broadcast(np.float32(0))
    for row in range(WINDOW):
        top, middle, low = row * _STRIDE, (row + 1) * _STRIDE, (row + 2) * _STRIDE
        falling = load(patch, low + 2) - load(patch, top)
        rising = load(patch, top + 2) - load(patch, low)
        unit = columns * np.float32(1 / 32 if first <= row < end else 0)
        x = unit * (3 * (falling + rising) + 10 * (load(patch, middle + 2) - load(patch, middle)))
        y = unit * (3 * (falling - rising) + 10 * (load(patch, low + 1) - load(patch, top + 1)))
        store(window, row * LANES, load(patch, middle + 1))
        store(window, _WINDOW_SIZE + row * LANES, x)
        store(window, 2 * _WINDOW_SIZE + row * LANES, y)
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
    return total(xx), total(xy), total(yy)


@njit(cache=True, nogil=True)
def _mismatch(level, stride, x, y, window):
    """Return the sums of a window's gradients times what the level differs by from it where it begins at a pixel."""
    begin, right, down = _place(stride, x, y)
    by_x = by_y = broadcast(np.float32(0))
    above = _row(level, begin, right)
    for row in range(WINDOW):
        below = _row(level, begin + (row + 1) * stride, right)
        off = above + down * (below - above) - load(window, row * LANES)
        by_x = by_x + off * load(window, _WINDOW_SIZE + row * LANES)
        by_y = by_y + off * load(window, 2 * _WINDOW_SIZE + row * LANES)
        above = below
    return total(by_x), total(by_y)
