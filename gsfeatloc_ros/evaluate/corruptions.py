"""Corruptions of photos that are of the scene: bad light, bad optics, things in the way."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

# Lengths are in pixels of a photo so wide.
_REFERENCE_WIDTH = 640
_DEFOCUS_SIGMA = 2.5
_MOTION_LENGTH = 15


def _expose(gain: float, gamma: float) -> Callable[[np.ndarray], np.ndarray]:
    """Make the function that multiplies the light and changes its curve."""
    levels = np.clip(gain * (np.arange(256) / 255.0) ** gamma, 0, 1)
    return lambda image: cv2.LUT(image, np.rint(255 * levels).astype(np.uint8))


def _shade(image: np.ndarray) -> np.ndarray:
    ramp = np.linspace(0.2, 1.3, image.shape[1])[None, :, None]
    return np.clip(image * ramp, 0, 255).astype(np.uint8)


def _add_noise(image: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0.0, 25.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def _defocus(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), _DEFOCUS_SIGMA * image.shape[1] / _REFERENCE_WIDTH)


def _move(image: np.ndarray) -> np.ndarray:
    return cv2.blur(image, (max(1, round(_MOTION_LENGTH * image.shape[1] / _REFERENCE_WIDTH)), 1))


def _cover(share: float) -> Callable[[np.ndarray], np.ndarray]:
    """Make the function that puts another part of the photo, upside down, over a share of it in the middle."""

    def cover(image: np.ndarray) -> np.ndarray:
        height, width = (round(share**0.5 * side) for side in image.shape[:2])
        top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
        covered = image.copy()
        covered[top : top + height, left : left + width] = image[:height, :width][::-1, ::-1]
        return covered

    return cover


CORRUPTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "dark": _expose(0.3, 1.5),
    "bright": _expose(1.4, 0.6),
    "shade": _shade,
    "noise": _add_noise,
    "defocus": _defocus,
    "motion": _move,
    "cover-20": _cover(0.2),
    "cover-40": _cover(0.4),
    "cover-60": _cover(0.6),
}
"""By name: functions from a photo (H, W, 3) uint8 RGB to a worse one of the same size."""
