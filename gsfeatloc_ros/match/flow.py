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
from gsfeatloc_ros.render.lanes import LANES, broadcast, load, store, total

WINDOW = 15
"""Pixels across and down the windows that are compared."""
MAX_LEVEL = 3
"""Levels of the pyramid are 0 to this."""
# Columns in memory of a window with a margin: lanes, which are one more than a window's columns, and the margins.
_STRIDE = LANES + 2
_HALF = np.float32((WINDOW - 1) / 2)
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
    moved, found = np.zeros((len(pixels), 2), np.float32), np.ones(len(pixels), np.bool_)
    shift = np.zeros((len(pixels), 2), np.float32)
    for level in reversed(range(len(here.levels))):
        corners = (pixels / 2**level).astype(np.float32)
        moved = corners + 2 * shift
        _follow(here.levels[level], there.levels[level], corners, moved, found)
        shift = moved - corners
    return moved, found


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(here, there, corners, moved, found):
    """Move the guesses `moved` (N, 2) to where the windows of a level's corners are in another, and say which are."""
    patch = np.empty((WINDOW + 2) * _STRIDE, np.float32)
    # Brightness of a window, and its gradient to the right and down: rows of lanes, of which the last is not used.
    window = np.empty((3, WINDOW * LANES), np.float32)
    used = np.empty(LANES, np.float32)
    for corner in range(len(corners)):
        found[corner] = False
        if not _is_inside(here, corners[corner]):
            continue
        _cut_out(here, corners[corner], patch)
        xx, xy, yy = _differentiate(patch, *_visible(here, corners[corner], used), window)
        least = (xx + yy - math.sqrt((xx - yy) ** 2 + 4 * xy**2)) / (2 * WINDOW * WINDOW)
        if least < _MIN_EIGENVALUE:
            continue
        scale = 1 / (xx * yy - xy * xy)
        before_x = before_y = np.float32(0)
        for iteration in range(_MAX_ITERATIONS):
            if not _is_inside(there, moved[corner]):
                break
            x, y = _mismatch(there, moved[corner], window)
            step_x, step_y = scale * (xy * y - yy * x), scale * (xy * x - xx * y)
            moved[corner, 0] += step_x
            moved[corner, 1] += step_y
            if step_x * step_x + step_y * step_y <= _MIN_STEP**2:
                break
            if iteration > 0 and abs(step_x + before_x) < _MIN_CHANGE and abs(step_y + before_y) < _MIN_CHANGE:
                moved[corner, 0] -= step_x / 2
                moved[corner, 1] -= step_y / 2
                break
            before_x, before_y = step_x, step_y
        found[corner] = _is_inside(there, moved[corner])


@njit(cache=True, nogil=True)
def _is_inside(level, pixel):
    """Return whether the window round a pixel has a part in the picture."""
    height, width = level.shape[0] - 2 * _BORDER, level.shape[1] - 2 * _BORDER
    x, y = math.floor(pixel[0] - _HALF), math.floor(pixel[1] - _HALF)
    return -WINDOW <= x < width and -WINDOW <= y < height


@njit(cache=True, nogil=True)
def _corner_of(level, pixel, margin):
    """Return where in a level the window round a pixel begins, with a margin; and its shares of the pixels after."""
    x, y = pixel[0] - _HALF, pixel[1] - _HALF
    left, top = math.floor(x), math.floor(y)
    begin = (top - margin + _BORDER) * level.shape[1] + left - margin + _BORDER
    return begin, np.float32(x - left), np.float32(y - top)


@njit(cache=True, nogil=True)
def _row(flat, at, share):
    """Return lanes of a picture from `at` on, moved to the right by a share of a pixel."""
    here = load(flat, at)
    return here + share * (load(flat, at + 1) - here)


@njit(cache=True, nogil=True)
def _cut_out(level, pixel, patch):
    """Fill in the window round a pixel with a margin of one, between the pixels."""
    flat, stride = level.ravel(), level.shape[1]
    begin, right, down = _corner_of(level, pixel, 1)
    for column in (0, _STRIDE - LANES):
        above = _row(flat, begin + column, right)
        for row in range(WINDOW + 2):
            below = _row(flat, begin + column + (row + 1) * stride, right)
            store(patch, row * _STRIDE + column, above + down * (below - above))
            above = below


@njit(cache=True, nogil=True)
def _visible(level, pixel, used):
    """Return which columns of the window round a pixel the picture has, as lanes, and its first and end row there."""
    height, width = level.shape[0] - 2 * _BORDER, level.shape[1] - 2 * _BORDER
    left, top = math.floor(pixel[0] - _HALF), math.floor(pixel[1] - _HALF)
    for column in range(LANES):
        used[column] = column < WINDOW and 0 <= left + column < width
    return load(used, 0), max(0, -top), min(WINDOW, height - top)


@njit(cache=True, nogil=True)
def _differentiate(patch, used, first, end, window):
    """Fill in a window from its patch, with Scharr's gradients; return the sums of their products xx, xy and yy.

    Columns that are not `used`, and rows before the `first` and from the `end` on, have no gradient.
    """
    xx = xy = yy = broadcast(np.float32(0))
    for row in range(WINDOW):
        top, middle, low = row * _STRIDE, (row + 1) * _STRIDE, (row + 2) * _STRIDE
        falling = load(patch, low + 2) - load(patch, top)
        rising = load(patch, top + 2) - load(patch, low)
        unit = used * np.float32(1 / 32 if first <= row < end else 0)
        x = unit * (3 * (falling + rising) + 10 * (load(patch, middle + 2) - load(patch, middle)))
        y = unit * (3 * (falling - rising) + 10 * (load(patch, low + 1) - load(patch, top + 1)))
        store(window[0], row * LANES, load(patch, middle + 1))
        store(window[1], row * LANES, x)
        store(window[2], row * LANES, y)
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
    return total(xx), total(xy), total(yy)


@njit(cache=True, nogil=True)
def _mismatch(level, pixel, window):
    """Return the sums of a window's gradients times what the level round a pixel differs by from it."""
    flat, stride = level.ravel(), level.shape[1]
    begin, right, down = _corner_of(level, pixel, 0)
    x = y = broadcast(np.float32(0))
    above = _row(flat, begin, right)
    for row in range(WINDOW):
        below = _row(flat, begin + (row + 1) * stride, right)
        off = above + down * (below - above) - load(window[0], row * LANES)
        x, y = x + off * load(window[1], row * LANES), y + off * load(window[2], row * LANES)
        above = below
    return total(x), total(y)
