"""How a photo is blurred: its corners can be tracked into a render that is blurred alike, not into a sharp one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from gsfeatloc_ros.common.local_structure import local_structure

# Photo and render are compared at this width.
_WIDTH = 320
# Blur shows where the photo's gradients along some direction have less than this share of the render's energy; or, as
# the map may be less sharp than photos are, where that share is less than this part of the one across: in a motion.
_MAX_ENERGY_RATIO = 0.45
_MAX_RELATIVE_RATIO = 0.55
# What the render's gradients are given in every direction, as a share of their energy.
_MIN_ENERGY = 1e-3
# Lengths of a motion and widths of a defocus that are tried, in shares of the photo's width.
_EXTENTS = np.array([4, 6, 9, 12, 16, 21, 27, 34]) / 640
_NEIGHBOURHOOD = 8.0
_MIN_CONTRAST = 4.0


@dataclass(frozen=True, eq=False)
class Blur:
    """How a photo is blurred.

    Attributes:
        kernel: (k, k) float32 that blurs a sharp picture alike.
        extent: length of the motion, or width of the defocus, in pixels.
    """

    kernel: np.ndarray
    extent: float


def estimate_blur(photo: np.ndarray, render: np.ndarray) -> Blur | None:
    """Return how a photo is blurred; None where it is as sharp as the render.

    The direction of a motion is that along which the photo's gradients have lost most against the render's; where they
    have lost about as much across, it is out of focus. Its length is that with which the blurred render correlates best
    with the photo. The motion is taken to be even and straight.

    Args:
        photo, render: (H, W) uint8 brightness of nearly the same view.
    """
    height, width = photo.shape
    size = (min(_WIDTH, width), max(1, round(height * min(_WIDTH, width) / width)))
    photo, render = (cv2.resize(gray, size, interpolation=cv2.INTER_AREA) for gray in (photo, render))
    make = _kind_of_blur(_gradient_tensor(photo), _gradient_tensor(render))
    if make is None:
        return None
    structure, _ = local_structure(photo, _NEIGHBOURHOOD, _MIN_CONTRAST)
    best, found = _correlation(structure, render), None
    for extent in _EXTENTS:
        correlation = _correlation(structure, cv2.filter2D(render, -1, make(extent * size[0])))
        if correlation > best:
            best, found = correlation, Blur(make(extent * width), extent * width)
    return found


def _kind_of_blur(photo: np.ndarray, render: np.ndarray) -> Callable[[float], np.ndarray] | None:
    """Return what makes kernels of the photo's blur by their extent in pixels, None where it has lost little.

    Args:
        photo, render: (2, 2) gradient tensors.
    """
    # The generalized eigenvalues are the ratios of energy; a little of all directions keeps the render's invertible.
    root = np.linalg.cholesky(render + _MIN_ENERGY * (np.trace(render) + 1.0) * np.eye(2))
    ratios, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, photo).T))
    if ratios[0] < _MAX_RELATIVE_RATIO * ratios[1]:
        x, y = np.linalg.solve(root.T, vectors[:, 0])
        return _Motion(float(np.arctan2(y, x)))
    return _defocus if ratios[0] < _MAX_ENERGY_RATIO else None


def _gradient_tensor(gray: np.ndarray) -> np.ndarray:
    """Return the mean outer product (2, 2) of the gradients of brightness (H, W) uint8."""
    x, y = (gradient.ravel().astype(np.float32) for gradient in cv2.spatialGradient(gray))
    return np.array([[x @ x, x @ y], [x @ y, y @ y]], np.float64) / gray.size


def _correlation(structure: np.ndarray, gray: np.ndarray) -> float:
    """Return the correlation of a local structure with that of brightness (H, W) uint8."""
    other, _ = local_structure(gray, _NEIGHBOURHOOD, _MIN_CONTRAST)
    norm = np.sqrt((structure**2).sum() * (other**2).sum())
    return float((structure * other).sum() / norm) if norm > 0 else 0.0


@dataclass(frozen=True)
class _Motion:
    """Makes kernels of motions along an angle, in radians, by a length in pixels."""

    angle: float

    def __call__(self, length: float) -> np.ndarray:
        reach = int(np.ceil(length / 2)) + 1
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        along = x * np.cos(self.angle) + y * np.sin(self.angle)
        across = y * np.cos(self.angle) - x * np.sin(self.angle)
        kernel = np.clip(length / 2 + 0.5 - np.abs(along), 0, 1) * np.clip(1 - np.abs(across), 0, 1)
        return (kernel / kernel.sum()).astype(np.float32)


def _defocus(width: float) -> np.ndarray:
    """Make the kernel of a defocus as wide as a motion by `width` pixels: of the same standard deviation."""
    sigma = width / np.sqrt(12)
    row = cv2.getGaussianKernel(2 * int(np.ceil(3 * sigma)) + 1, sigma)
    return (row @ row.T).astype(np.float32)
