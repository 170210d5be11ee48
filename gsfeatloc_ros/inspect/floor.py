"""The floor of a map: the lowest large plane of surfaces below the cameras that is about level.

Maps may have more below it: what shiny floors reflect, or layers that fill holes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.maps.gaussian_map import SOLID_OPACITY, GaussianMap

# Gaussians looked at.
_MAX_GAUSSIANS = 200_000
# Shares of the cameras' height above what is lowest: how thick a plane is from fit to fit; at last it has to settle.
_BANDS = (0.15, 0.1, 0.06, 0.03, *[0.02] * 10)
# Radians by which the floor may be off level.
_MAX_TILT = np.radians(10.0)
# A plane of less than this share of the largest one's area is no floor: what lies below the floor is little.
_LEAST_SHARE = 0.25
# Heights at which planes are looked for.
_PLACES = 40
# Share of the cameras' height within which planes are layers of one floor, of which the upper one is seen.
_LAYERS = 0.1
# Shares of the Gaussians that lie lower, or higher, than all that counts.
_LOWEST = 0.01


@dataclass(frozen=True, eq=False)
class Floor:
    """A plane.

    Attributes:
        normal: (3,) up.
        point: (3,) on it, below the cameras.
        residual: median distance of its surfaces from it.
        share: of the area of all surfaces below the cameras.
    """

    normal: np.ndarray
    point: np.ndarray
    residual: float
    share: float


def surface_samples(gaussians: GaussianMap) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (N, 3), frame in which the map lies, of solid Gaussians, and about their areas (N,)."""
    solid = np.flatnonzero(gaussians.opacities > SOLID_OPACITY)
    rows = solid[:: max(1, -(-len(solid) // _MAX_GAUSSIANS))]
    widths = np.sort(gaussians.scales[rows], axis=1).astype(np.float64)
    centres = gaussians.S_map_splat.transform(gaussians.means[rows].astype(np.float64))
    return centres, widths[:, 1] * widths[:, 2] * gaussians.S_map_splat.scale**2


def find_floor(points: np.ndarray, areas: np.ndarray, cameras: np.ndarray, up: np.ndarray) -> Floor | None:
    """Find the floor; None where there is nothing level below the cameras.

    Args:
        points: (N, 3) on surfaces.
        areas: (N,) that they stand for.
        cameras: (M, 3) above the floor.
        up: (3,) unit vector, right within some degrees.
    """
    camera_height = float(np.median(cameras @ up))
    below = points @ up < np.min(cameras @ up)
    points, areas = points[below], areas[below]
    if len(points) < 3:
        return None
    # One huge Gaussian is no plane.
    areas = np.minimum(areas, np.quantile(areas, 0.99))
    heights = points @ up
    bottom = float(np.quantile(heights, _LOWEST))
    size = camera_height - bottom
    found = [
        plane
        for height in np.linspace(bottom, float(heights.max()), _PLACES)
        if (plane := _plane_near(points, areas, up, height, size)) is not None
    ]
    if not found:
        return None
    largest = max(plane.share for plane in found)
    centre = cameras.mean(axis=0)
    candidates = [plane for plane in found if plane.share >= _LEAST_SHARE * largest]
    lowest = min(float(_foot(plane, centre) @ up) for plane in candidates)
    layers = [plane for plane in candidates if _foot(plane, centre) @ up < lowest + _LAYERS * size]
    thick = max(plane.share for plane in layers)
    floor = max((plane for plane in layers if plane.share >= 0.5 * thick), key=lambda plane: _foot(plane, centre) @ up)
    return Floor(floor.normal, _foot(floor, centre), floor.residual, floor.share)


def _foot(plane: Floor, above: np.ndarray) -> np.ndarray:
    """Return the point (3,) of a plane that is nearest to a point (3,)."""
    return above - plane.normal * (plane.normal @ (above - plane.point))


def _plane_near(points: np.ndarray, areas: np.ndarray, up: np.ndarray, height: float, size: float) -> Floor | None:
    """Fit a plane to what lies about a height, ever thinner; None where that is not level or nothing is there."""
    normal, point = up, height * up
    for band in _BANDS:
        near = np.abs((points - point) @ normal) < band * size
        if near.sum() < 3:
            return None
        weights = areas[near] / areas[near].sum()
        point = weights @ points[near]
        offsets = points[near] - point
        _, axes = np.linalg.eigh(offsets.T @ (weights[:, None] * offsets))
        normal = axes[:, 0] * np.sign(axes[:, 0] @ up)
        if normal @ up < np.cos(_MAX_TILT):
            return None
    distances = np.abs((points - point) @ normal)
    on = distances < _BANDS[-1] * size
    return Floor(normal, point, float(np.median(distances[on])), float(areas[on].sum() / areas.sum()))
