"""The local structure of brightness: what photo and render have in common when exposure and shading differ."""

from __future__ import annotations

import cv2
import numpy as np


def local_structure(gray: np.ndarray, neighbourhood: float, min_contrast: float) -> tuple[np.ndarray, np.ndarray]:
    """Return brightness less its local mean, over its local standard deviation.

    Args:
        gray: (H, W) uint8.
        neighbourhood: standard deviation, in pixels, of the Gaussian window.
        min_contrast: what is divided by at least, of 255: noise on a blank wall is no structure.

    Returns:
        The structure (H, W) float32, and the local standard deviation (H, W) float32.
    """
    gray = gray.astype(np.float32)
    centred = gray - cv2.GaussianBlur(gray, (0, 0), neighbourhood)
    contrast = np.sqrt(cv2.GaussianBlur(centred**2, (0, 0), neighbourhood))
    return centred / np.maximum(contrast, min_contrast), contrast
