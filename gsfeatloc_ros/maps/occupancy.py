"""A map seen from above at the height of a robot: where something is in its way, and where there is floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.maps.gaussian_map import SOLID_OPACITY, GaussianMap

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
# Gaussians are drawn up to so many standard deviations, as points no farther apart than half a cell, so many to an axis
# at most.
_EXTENT = 1.5
_MAX_POINTS = 33
# Map units below the slice down to which what is there is floor.
_FLOOR_DEPTH = 0.3
# Share of what is seen of the map that lies beyond each edge of the grid: floaters are far away.
_OUTSIDE = 0.002
# Cells of an edge.
_MAX_CELLS = 4096


@dataclass(frozen=True)
class Slice:
    """What of a map is in a robot's way.

    Attributes:
        low, high: heights above z = 0, map units.
        resolution: of the grid, map units of a cell.

    Raises:
        ValueError: the slice has no height.
    """

    low: float
    high: float
    resolution: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(
                f"parameter map.occupancy_max_height is {self.high:g}: it must be above map.occupancy_min_height, "
                f"{self.low:g}"
            )


@dataclass(frozen=True, eq=False)
class Occupancy:
    """A grid of cells in the plane z = 0 of the map frame.

    Attributes:
        cells: (H, W) int8, rows along y: OCCUPIED, FREE where floor is seen, UNKNOWN elsewhere.
        resolution: map units of a cell.
        origin: (2,) x and y of the corner of the first cell.
    """

    cells: np.ndarray
    resolution: float
    origin: np.ndarray


def occupancy(gaussian_map: GaussianMap, slice_: Slice) -> Occupancy:
    """Return what is in the slice of a map whose z axis is up and whose floor is z = 0.

    Only Gaussians that cover more than a half count. Where none does the grid is empty, (0, 0).
    """
    points = _surface(gaussian_map, slice_)
    heights = points[:, 2]
    in_the_way = points[(heights >= slice_.low) & (heights <= slice_.high), :2]
    floor = points[(heights >= slice_.low - _FLOOR_DEPTH) & (heights < slice_.low), :2]
    seen = np.concatenate([in_the_way, floor])
    if not len(seen):
        return Occupancy(np.zeros((0, 0), np.int8), slice_.resolution, np.zeros(2))
    low, high = np.quantile(seen, (_OUTSIDE, 1.0 - _OUTSIDE), axis=0)
    origin = np.floor(low / slice_.resolution - 1.0) * slice_.resolution
    size = np.minimum(np.ceil((high - origin) / slice_.resolution).astype(int) + 1, _MAX_CELLS)
    cells = np.full(size[::-1], UNKNOWN, np.int8)
    for where, value in ((floor, FREE), (in_the_way, OCCUPIED)):
        places = np.floor((where - origin) / slice_.resolution).astype(int)
        inside = places[np.all((places >= 0) & (places < size), axis=1)]
        cells[inside[:, 1], inside[:, 0]] = value
    return Occupancy(cells, slice_.resolution, origin)


def _surface(gaussian_map: GaussianMap, slice_: Slice) -> np.ndarray:
    """Return points (n, 3) all over the solid Gaussians near the slice, map frame."""
    S_map_splat = gaussian_map.S_map_splat
    centres = S_map_splat.transform(gaussian_map.means.astype(np.float64))
    reach = _EXTENT * S_map_splat.scale * gaussian_map.scales.max(axis=1)
    near = (
        (gaussian_map.opacities > SOLID_OPACITY)
        & (centres[:, 2] + reach > slice_.low - _FLOOR_DEPTH)
        & (centres[:, 2] - reach < slice_.high)
    )
    axes = _longer_axes(gaussian_map, near)
    counts = np.clip(np.ceil(4.0 * _EXTENT * np.linalg.norm(axes, axis=1) / slice_.resolution), 1, _MAX_POINTS)
    # As many points to each axis as to the powers of two above: Gaussians are drawn together by these.
    counts = 2 ** np.ceil(np.log2(counts)).astype(int)
    found = [np.zeros((0, 3))]
    for first, second in np.unique(counts, axis=0):
        alike = np.all(counts == (first, second), axis=1)
        steps = [_EXTENT * ((np.arange(count) + 0.5) / count * 2.0 - 1.0) for count in (first, second)]
        grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
        grid = grid[np.linalg.norm(grid, axis=1) <= _EXTENT]
        found.append((centres[near][alike][:, None] + np.einsum("gk,nak->nga", grid, axes[alike])).reshape(-1, 3))
    return np.concatenate(found)


def _longer_axes(gaussian_map: GaussianMap, chosen: np.ndarray) -> np.ndarray:
    """Return the two longer axes (n, 3, 2) of chosen Gaussians, a standard deviation long, map frame."""
    from scipy.spatial.transform import Rotation

    scales, rotations = gaussian_map.scales[chosen], gaussian_map.rotations[chosen]
    if not len(scales):
        return np.zeros((0, 3, 2))
    turned = gaussian_map.S_map_splat.rotation @ Rotation.from_quat(rotations[:, [1, 2, 3, 0]]).as_matrix()
    longer = np.argsort(scales, axis=1)[:, 1:]
    directions = np.take_along_axis(turned, longer[:, None], axis=2)
    return gaussian_map.S_map_splat.scale * directions * np.take_along_axis(scales, longer, axis=1)[:, None]
