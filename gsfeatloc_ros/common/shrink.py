"""Pictures of fewer pixels, each of which is the mean of the area that it covers.

OpenCV's INTER_AREA is fast where sides shrink by whole factors. By others this makes the same in a sixth of the time.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

# Narrower pictures do not fill the processor's vectors.
_MIN_WIDTH = 16
# What is covered of a pixel by less counts as nothing, as in OpenCV.
_MIN_SHARE = 1e-3


def shrunk(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return a picture (H, W) or (H, W, C) uint8 of another size; where that is larger, as OpenCV enlarges it."""
    rows, columns, *channels = picture.shape
    channel_count = channels[0] if channels else 1
    whole = columns % width == 0 and rows % height == 0
    if whole or width > columns or height > rows or width < _MIN_WIDTH:
        return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    # Not before the first: numba takes a second to load, and makes a folder.
    from gsfeatloc_ros.common.shrink_kernel import shrink

    made = np.empty((height, width, *channels), np.uint8)
    down, across = _shares(rows, height), _shares(columns, width)
    # To numba, what may not be written to is of another type: it would compile another kernel.
    flat = np.require(picture, requirements=["C", "W"]).reshape(rows, -1)
    shrink(flat, channel_count, *down, *across, made.reshape(height, -1))
    return made


@lru_cache(maxsize=8)
def _shares(count: int, fewer: int) -> tuple[np.ndarray, np.ndarray]:
    """Return of which of `count` pixels each of `fewer` is made: the first (N,) int64, and shares (N, K) from it on."""
    scale = count / fewer
    begin, most = np.arange(fewer) * scale, min(int(np.ceil(scale)) + 1, count)
    first = np.minimum(begin.astype(np.int64), count - most)
    pixels = first[:, None] + np.arange(most)
    covered = np.minimum(pixels + 1, begin[:, None] + scale) - np.maximum(pixels, begin[:, None])
    shares = np.where(covered > _MIN_SHARE, covered, 0.0)
    return first, (shares / shares.sum(axis=1, keepdims=True)).astype(np.float32)
