"""A map as coloured points, for people who look at it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.maps.assemble import SH_C0
from gsfeatloc_ros.maps.gaussian_map import GaussianMap


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of a map.

    Attributes:
        points: (n, 3) float32, map frame.
        colours: (n, 3) uint8 RGB.
    """

    points: np.ndarray
    colours: np.ndarray


def point_cloud(gaussian_map: GaussianMap, count: int) -> PointCloud:
    """Return the centres of up to `count` Gaussians, those of most opacity times size, as they look from all sides.

    The size is the geometric mean of the two longer axes: splats are flat.
    """
    axes = np.sort(gaussian_map.scales, axis=1)
    weights = gaussian_map.opacities * np.sqrt(axes[:, 1] * axes[:, 2])
    count = min(count, len(weights))
    chosen = np.argpartition(weights, len(weights) - count)[len(weights) - count :]
    points = gaussian_map.S_map_splat.transform(gaussian_map.means[chosen].astype(np.float64))
    return PointCloud(points.astype(np.float32), seen_colours(gaussian_map, chosen))


def seen_colours(gaussian_map: GaussianMap, rows: np.ndarray) -> np.ndarray:
    """Return how Gaussians by their rows (n,) look from all sides: (n, 3) uint8 RGB."""
    levels = 0.5 + SH_C0 * gaussian_map.sh[rows, 0].astype(np.float32)
    return np.rint(255 * np.clip(levels, 0, 1)).astype(np.uint8)
