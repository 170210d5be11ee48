"""The local structure of brightness: what photo and render have in common when exposure and shading differ."""

from __future__ import annotations

import cv2
import numpy as np

# What is smooth over a neighbourhood is computed in pictures so small that its standard deviation is three pixels.
_SIGMA = 3.0


def local_structure(gray: np.ndarray, neighbourhood: float, min_contrast: float) -> tuple[np.ndarray, np.ndarray]:
    """Return brightness less its local mean, over its local standard deviation.

    Args:
        gray: (H, W) uint8.
        neighbourhood: standard deviation, in pixels, of the Gaussian window.
        min_contrast: what is divided by at least, of 255: noise on a blank wall is no structure.

    Returns:
        The structure (H, W) float32, and the local standard deviation (H, W) float32.
    """
    height, width = gray.shape
    factor = max(1, int(neighbourhood / _SIGMA))
    # Whole blocks of pixels are averaged: that is several times faster than shares of them. Pictures are written over:
    # new ones cost more than what is computed.
    gray = cv2.copyMakeBorder(gray, 0, -height % factor, 0, -width % factor, cv2.BORDER_REPLICATE)
    centred = gray.astype(np.float32)
    mean = _enlarged(_smooth(centred, factor, neighbourhood), factor)
    centred -= mean
    squared = np.multiply(centred, centred, out=mean)
    contrast = _enlarged(np.sqrt(_smooth(squared, factor, neighbourhood)), factor)
    centred /= np.maximum(contrast, min_contrast, out=squared)
    return centred[:height, :width], contrast[:height, :width]


def _smooth(picture: np.ndarray, factor: int, sigma: float) -> np.ndarray:
    """Return a picture smoothed by a Gaussian window of `sigma` pixels, in blocks of `factor` x `factor` pixels."""
    height, width = picture.shape
    blocks = cv2.resize(picture, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(blocks, (0, 0), sigma / factor)


def _enlarged(blocks: np.ndarray, factor: int) -> np.ndarray:
    height, width = blocks.shape
    return cv2.resize(blocks, (width * factor, height * factor), interpolation=cv2.INTER_LINEAR)
