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


class CloudMaker:
    """Makes the cloud of a map, part by part: the centres of its Gaussians, as they look from all sides.

    Args:
        count: points at most; of more Gaussians those of most opacity times size are taken. The size is the geometric
            mean of the two longer axes: splats are flat.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._weights = np.zeros(0, np.float32)
        self._points, self._colours = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)

    def add(self, part: GaussianMap) -> None:
        """Take a part of the map in."""
        axes = np.sort(part.scales, axis=1)
        weights = part.opacities * np.sqrt(axes[:, 1] * axes[:, 2])
        chosen = _largest(weights, self._count)
        points = part.S_map_splat.transform(part.means[chosen].astype(np.float64)).astype(np.float32)
        weights = np.concatenate([self._weights, weights[chosen]])
        kept = _largest(weights, self._count)
        self._weights = weights[kept]
        self._points = np.concatenate([self._points, points])[kept]
        self._colours = np.concatenate([self._colours, seen_colours(part, chosen)])[kept]

    def cloud(self) -> PointCloud:
        """Return the cloud of the parts that were taken in."""
        return PointCloud(self._points, self._colours)


def _largest(weights: np.ndarray, count: int) -> np.ndarray:
    """Return the places of up to `count` largest of some weights (n,)."""
    left_out = max(len(weights) - count, 0)
    return np.argpartition(weights, left_out)[left_out:] if left_out < len(weights) else np.arange(0)


def seen_colours(gaussian_map: GaussianMap, rows: np.ndarray) -> np.ndarray:
    """Return how Gaussians by their rows (n,) look from all sides: (n, 3) uint8 RGB."""
    levels = 0.5 + SH_C0 * gaussian_map.sh[rows, 0].astype(np.float32)
    return np.rint(255 * np.clip(levels, 0, 1)).astype(np.uint8)
