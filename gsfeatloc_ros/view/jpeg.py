"""Pictures that are kept, small."""

from __future__ import annotations

import cv2
import numpy as np

_QUALITY = 85


def encoded(rgb: np.ndarray) -> np.ndarray:
    """Return a picture (H, W, 3) uint8 RGB as the bytes (n,) of a JPEG."""
    return cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]


def decoded(jpeg: np.ndarray) -> np.ndarray:
    """Return the pixels (H, W, 3) uint8 RGB of what `encoded` returned."""
    bgr = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    assert bgr is not None
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
