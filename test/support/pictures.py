"""Made-up pictures for matchers and trackers, and pictures moved by a known shift."""

from __future__ import annotations

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.photo import Photo


def rectangles(height: int, width: int) -> np.ndarray:
    """Overlapping bright and dark rectangles, turned at random, as smooth as a photo."""
    rng = np.random.default_rng(3)
    image = np.full((height, width, 3), 128, np.uint8)
    for _ in range(height * width // 150):
        center, size = rng.uniform([0, 0], [width, height]), rng.uniform(6, 40, 2)
        corners = cv2.boxPoints((center.tolist(), size.tolist(), rng.uniform(0, 90)))
        cv2.fillConvexPoly(image, corners.astype(np.int32), rng.integers(0, 256, 3).tolist(), cv2.LINE_AA)
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def shifted(image: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """The image moved right and down by a fraction of a pixel."""
    move = np.float64([[1, 0, dx], [0, 1, dy]])
    return cv2.warpAffine(image, move, image.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def photo_of(image: np.ndarray) -> Photo:
    """Return the picture (H, W, 3) as the photo of a pinhole camera."""
    height, width = image.shape[:2]
    K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
    return Photo.undistorted(image, Camera(width, height, K), width)


def smooth_noise(seed: int, height: int = 120, width: int = 160) -> np.ndarray:
    """Smooth noise with structure of several sizes."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.normal(size=(height, width, 3)), (0, 0), sigma) * sigma for sigma in (1.5, 4, 9)]
    return np.clip(128 + 40 * sum(layers), 0, 255).astype(np.uint8)
