"""The loops of common/local_structure.py: one pass over a picture for each thing that needs all of it."""

from __future__ import annotations

import math

import numpy as np

from gsfeatloc_ros.common.kernels import njit


@njit(cache=True, nogil=True, error_model="numpy")
def mean_rows(gray, factor):
    """Return the means (h, W) float32 of every `factor` rows of a picture (h factor, W) uint8 or float32."""
    means = np.zeros((len(gray) // factor, gray.shape[1]), np.float32)
    for block in range(len(means)):
        mean = means[block]
        for row in range(block * factor, (block + 1) * factor):
            line = gray[row]
            for x in range(len(mean)):
                mean[x] += np.float32(line[x])
    means /= np.float32(factor)
    return means


@njit(cache=True, nogil=True, error_model="numpy")
def centre(gray, means, factor):
    """Take the local mean (h, W) float32 of every `factor` rows, between which it is interpolated, out of brightness.

    Return what is left of the brightness (h factor, W) uint8, float32, and the means (h, W) of the squares of that.
    """
    height, width = gray.shape
    centred, squares = np.empty((height, width), np.float32), np.zeros(means.shape, np.float32)
    for block in range(len(means)):
        square = squares[block]
        for row in range(block * factor, (block + 1) * factor):
            above, below, share = _between(row, factor, len(means))
            line, upper, lower, left = gray[row], means[above], means[below], centred[row]
            for x in range(width):
                left[x] = np.float32(line[x]) - (upper[x] + share * (lower[x] - upper[x]))
                square[x] += left[x] * left[x]
    squares /= np.float32(factor)
    return centred, squares


@njit(cache=True, nogil=True, error_model="numpy")
def divide(centred, deviations, factor, least):
    """Divide a picture (h factor, W) float32, in place, by deviations (h, W), as those of `centre`, or by the `least`.

    Return the deviations of all rows, (h factor, W) float32.
    """
    height, width = centred.shape
    everywhere = np.empty((height, width), np.float32)
    for row in range(height):
        above, below, share = _between(row, factor, len(deviations))
        line, upper, lower, deviation = centred[row], deviations[above], deviations[below], everywhere[row]
        for x in range(width):
            deviation[x] = upper[x] + share * (lower[x] - upper[x])
            line[x] /= max(deviation[x], least)
    return everywhere


@njit(cache=True, nogil=True, error_model="numpy")
def _between(row, factor, count):
    """Return between which two of `count` rows of blocks, at their middles, a row is, and the share of the second."""
    place = (row + 0.5) / factor - 0.5
    above = math.floor(place)
    share = np.float32(place - above)
    return max(above, 0), min(above + 1, count - 1), share
