"""Real spherical harmonics of degree 0 to 3, in the order and with the signs of the INRIA rasterizer."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS


def harmonics(x: Any, y: Any, z: Any) -> list[Any]:
    """Return the 16 harmonics in the unit directions x, y, z: arrays (N,) of numpy or tensors of torch, and so they."""
    return [
        0.28209479177387814 + 0 * x,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]


def turned(axes: np.ndarray) -> np.ndarray:
    """Return the matrix (16, 16) float32 of the harmonics' coefficients in other axes.

    `axes` (3, 3) maps points into these; it turns, and may mirror.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = (np.stack(harmonics(*d.T), axis=1) for d in (directions @ axes, directions))
    matrix = np.zeros((SH_COEFFICIENTS[-1], SH_COEFFICIENTS[-1]))
    for start, end in zip((0, *SH_COEFFICIENTS), SH_COEFFICIENTS, strict=False):  # degrees do not mix
        matrix[start:end, start:end] = np.linalg.lstsq(after[:, start:end], before[:, start:end], rcond=None)[0]
    return matrix.round(12).astype(np.float32)
