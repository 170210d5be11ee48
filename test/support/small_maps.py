"""Small maps of Gaussians to render, a camera for them, and how far two renders are apart."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps import GaussianMap
from gsfeatloc_ros.maps.assemble import SH_C0
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS
from gsfeatloc_ros.render import Render


def random_map(count: int, sh_degree: int, seed: int) -> GaussianMap:
    """Gaussians of many sizes, shapes and opacities, 1 to 6 units ahead of and a little behind the origin."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(count, 4))
    sh = rng.normal(scale=0.3, size=(count, SH_COEFFICIENTS[sh_degree], 3))
    return GaussianMap(
        means=rng.uniform([-3, -2, -1], [3, 2, 6], (count, 3)).astype(np.float32),
        scales=np.exp(rng.uniform(-6, -0.5, (count, 3))).astype(np.float32),
        rotations=(rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        opacities=rng.uniform(0, 1, count).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def one_gaussian(mean, scale, opacity: float, color=(0.9, 0.5, 0.1)) -> GaussianMap:
    """A map of one axis-aligned Gaussian of one colour."""
    return GaussianMap(
        means=np.array([mean], dtype=np.float32),
        scales=np.broadcast_to(np.float32(scale), (1, 3)).copy(),
        rotations=np.array([[1, 0, 0, 0]], dtype=np.float32),
        opacities=np.array([opacity], dtype=np.float32),
        sh=((np.array(color, dtype=np.float32) - 0.5) / SH_C0).reshape(1, 1, 3),
    )


def concatenated(*maps: GaussianMap) -> GaussianMap:
    fields = ("means", "scales", "rotations", "opacities", "sh")
    return GaussianMap(**{field: np.concatenate([getattr(m, field) for m in maps]) for field in fields})


def small_camera(width: int = 75, height: int = 53) -> Camera:
    """A camera whose size is no multiple of the tile's, with its centre off the middle and unequal focal lengths."""
    return Camera(width, height, np.array([[70.0, 0, 0.45 * width], [0, 66.0, 0.52 * height], [0, 0, 1]]))


def psnr(a: Render, b: Render) -> float:
    return -10 * np.log10(np.mean((a.rgb.astype(np.float64) - b.rgb) ** 2) + 1e-20)


def assert_same(fast: Render, reference: Render, decibels: float) -> None:
    assert psnr(fast, reference) >= decibels
    np.testing.assert_allclose(fast.alpha, reference.alpha, atol=5e-3)
    both = np.isfinite(fast.depth) & np.isfinite(reference.depth)
    # Where alpha is at the limit, rounding decides whether there is a depth.
    assert np.mean(np.isfinite(fast.depth) == np.isfinite(reference.depth)) > 0.999
    if both.any():
        error = np.abs(fast.depth - reference.depth)[both] / reference.depth[both]
        assert np.median(error) <= 1e-4
        assert np.quantile(error, 0.999) <= 1e-3
        spread_error = np.abs(fast.depth_std - reference.depth_std)[both] / reference.depth[both]
        assert np.quantile(spread_error, 0.99) <= 1e-3
