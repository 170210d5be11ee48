"""The local structure of brightness: what photo and render have in common when exposure and shading differ."""

from __future__ import annotations

import cv2
import numpy as np

# What is smooth over a neighbourhood is computed in pictures so small that its standard deviation is three pixels.
_SIGMA = 3.0
# Where less of a neighbourhood counts, it is taken to be so much.
_MIN_COUNTED = 1e-3


def local_structure(
    gray: np.ndarray, neighbourhood: float, min_contrast: float, counted: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return brightness less its local mean, over its local standard deviation.

    Args:
        gray: (H, W) uint8.
        neighbourhood: standard deviation, in pixels, of the Gaussian window.
        min_contrast: what is divided by at least, of 255: noise on a blank wall is no structure.
        counted: (H, W) bool, of which pixels mean and deviation are, and which have a structure; None for all. By what
            lies beside them they are not changed (normalized convolution: Knutsson and Westin, 1993).

    Returns:
        The structure (H, W) float32, 0 where pixels do not count, and the local standard deviation (H, W) float32.
    """
    # Not before the first: numba takes a second to load, and makes a folder.
    from gsfeatloc_ros.common.block_kernels import centre, divide, mean_rows

    height, width = gray.shape
    factor = max(1, int(neighbourhood / _SIGMA))
    sigma = neighbourhood / factor

    def padded(picture: np.ndarray) -> np.ndarray:
        return cv2.copyMakeBorder(picture, 0, -height % factor, 0, -width % factor, cv2.BORDER_REPLICATE)

    def mean(picture: np.ndarray) -> np.ndarray:
        return _smooth(mean_rows(picture, factor), factor, sigma)

    gray = padded(gray)
    if counted is None:
        structure, squares = centre(gray, _widened(mean(gray), factor), factor)
        variance = _smooth(squares, factor, sigma)
    else:
        counts = padded(counted.astype(np.uint8))
        share = np.maximum(mean(counts), _MIN_COUNTED)
        structure, _ = centre(gray, _widened(mean(gray * counts) / share, factor), factor)
        structure *= counts
        variance = mean(structure**2) / share
    contrast = divide(structure, _widened(np.sqrt(variance), factor), factor, np.float32(min_contrast))
    return structure[:height, :width], contrast[:height, :width]


def _smooth(rows: np.ndarray, factor: int, sigma: float) -> np.ndarray:
    """Return the means (h, w) of `factor` columns of rows (h, factor w), smoothed by a Gaussian window of `sigma`."""
    height, width = rows.shape
    return cv2.GaussianBlur(cv2.resize(rows, (width // factor, height), interpolation=cv2.INTER_AREA), (0, 0), sigma)


def _widened(blocks: np.ndarray, factor: int) -> np.ndarray:
    """Return blocks (h, w) interpolated to rows (h, factor w)."""
    height, width = blocks.shape
    return cv2.resize(blocks, (factor * width, height), interpolation=cv2.INTER_LINEAR)
