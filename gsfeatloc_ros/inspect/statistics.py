"""The Gaussians of a map in numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.maps.gaussian_map import SOLID_OPACITY, GaussianMap

# Percentiles that stand for the bounds of what is solid: a few Gaussians far off make no map larger.
_PERCENTILES = (1, 50, 99)
_OPACITY_BINS = 20
_SCALE_BINS = 24


@dataclass(frozen=True)
class Histogram:
    """Counts between edges, one more than there are counts."""

    edges: list[float]
    counts: list[int]


@dataclass(frozen=True)
class Statistics:
    """The Gaussians, in units of the map frame.

    Attributes:
        count: their number.
        sh_degree: of their colours, as they are read.
        antialiased: whether they are drawn so.
        solid: share of those that cover more than a half.
        low, high: box of all centres.
        solid_low, solid_median, solid_high: percentiles 1, 50 and 99 of the solid ones' centres.
        opacity: histogram of the opacities.
        scale: histogram of the largest standard deviation of each, edges in powers of ten.
        flatness: median of the smallest over the largest standard deviation.
    """

    count: int
    sh_degree: int
    antialiased: bool
    solid: float
    low: list[float]
    high: list[float]
    solid_low: list[float]
    solid_median: list[float]
    solid_high: list[float]
    opacity: Histogram
    scale: Histogram
    flatness: float


def describe_gaussians(map_: GaussianMap) -> Statistics:
    """Return the numbers of a map of at least one Gaussian."""
    placed = map_.S_map_splat
    means = placed.transform(map_.means.astype(np.float64))
    solid = map_.opacities > SOLID_OPACITY
    chosen = means[solid] if solid.any() else means
    percentiles = np.percentile(chosen, _PERCENTILES, axis=0)
    largest = placed.scale * map_.scales.max(axis=1).astype(np.float64)
    logarithms = np.log10(largest)
    opacity = np.histogram(map_.opacities, np.linspace(0, 1, _OPACITY_BINS + 1))
    scale = np.histogram(logarithms, np.linspace(*_padded(logarithms), _SCALE_BINS + 1))
    return Statistics(
        count=len(map_),
        sh_degree=map_.sh_degree,
        antialiased=map_.antialiased,
        solid=float(solid.mean()),
        low=means.min(axis=0).tolist(),
        high=means.max(axis=0).tolist(),
        solid_low=percentiles[0].tolist(),
        solid_median=percentiles[1].tolist(),
        solid_high=percentiles[2].tolist(),
        opacity=Histogram(opacity[1].tolist(), opacity[0].tolist()),
        scale=Histogram(scale[1].tolist(), scale[0].tolist()),
        flatness=float(np.median(map_.scales.min(axis=1) / map_.scales.max(axis=1))),
    )


def _padded(values: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest value, apart."""
    return float(values.min()) - 1e-6, float(values.max()) + 1e-6
