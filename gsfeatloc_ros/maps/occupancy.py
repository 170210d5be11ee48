"""A map seen from above at the height of a robot: where something is in its way, and where there is floor."""

from __future__ import annotations

from collections.abc import Iterator
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
# Cells from the origin beyond which all is as far away.
_MAX_PLACE = 2**30
# Points that are made, and that are kept before they are counted.
_POINTS_AT_ONCE, _MAX_NEW = 1 << 17, 1 << 19


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


class OccupancyMaker:
    """Makes the grid of what is in the slice of a map, part by part; its z axis is up and its floor z = 0.

    Only Gaussians that cover more than a half count. Where none does the grid is empty, (0, 0).
    """

    def __init__(self, slice_: Slice) -> None:
        self._slice = slice_
        # Cells in which there is something, and how many points there.
        self._floor, self._in_the_way = _Cells(), _Cells()

    def add(self, part: GaussianMap) -> None:
        """Take a part of the map in."""
        low, high = self._slice.low, self._slice.high
        for points in _surface(part, self._slice):
            heights, places = points[:, 2], np.floor(points[:, :2] / self._slice.resolution)
            self._in_the_way.add(places[(heights >= low) & (heights <= high)])
            self._floor.add(places[(heights >= low - _FLOOR_DEPTH) & (heights < low)])

    def grid(self) -> Occupancy:
        """Return the grid of the parts that were taken in."""
        floor, in_the_way = self._floor.found(), self._in_the_way.found()
        places, counts = (np.concatenate(both) for both in zip(floor, in_the_way, strict=True))
        if not len(places):
            return Occupancy(np.zeros((0, 0), np.int8), self._slice.resolution, np.zeros(2))
        edges = np.array([_quantiles(places[:, axis], counts) for axis in range(2)])
        first = edges[:, 0] - 1
        size = np.minimum(edges[:, 1] - first + 2, _MAX_CELLS)
        cells = np.full(size[::-1], UNKNOWN, np.int8)
        for (where, _), value in ((floor, FREE), (in_the_way, OCCUPIED)):
            inside = where[np.all((where >= first) & (where < first + size), axis=1)] - first
            cells[inside[:, 1], inside[:, 0]] = value
        return Occupancy(cells, self._slice.resolution, first * self._slice.resolution)


class _Cells:
    """Cells, by their places x and y, and how many points are in each."""

    def __init__(self) -> None:
        # A cell is one number: to sort numbers takes a fraction of the time of sorting rows.
        self._cells: np.ndarray = np.zeros(0, np.int64)
        self._counts: np.ndarray = np.zeros(0, np.int64)
        self._new: list[np.ndarray] = []

    def add(self, places: np.ndarray) -> None:
        """Count points at places (n, 2)."""
        counted = (np.clip(places, -_MAX_PLACE, _MAX_PLACE - 1) + _MAX_PLACE).astype(np.int64)
        self._new.append(counted[:, 0] * (2 * _MAX_PLACE) + counted[:, 1])
        if sum(map(len, self._new)) > _MAX_NEW:
            self.found()

    def found(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the places (n, 2) int64 of the cells, and the number of points (n,) int64 in each."""
        counts = np.concatenate([self._counts, *(np.ones(len(new), np.int64) for new in self._new)])
        self._cells, cells = np.unique(np.concatenate([self._cells, *self._new]), return_inverse=True)
        self._counts = np.bincount(cells, counts, len(self._cells)).astype(np.int64)
        self._new = []
        places = np.column_stack([self._cells // (2 * _MAX_PLACE), self._cells % (2 * _MAX_PLACE)])
        return places - _MAX_PLACE, self._counts


def _quantiles(places: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return between which places along an axis all but _OUTSIDE of the points lie at each end."""
    order = np.argsort(places)
    share = np.cumsum(counts[order]) / counts.sum()
    return places[order][np.searchsorted(share, [_OUTSIDE, 1.0 - _OUTSIDE])]


def _surface(gaussian_map: GaussianMap, slice_: Slice) -> Iterator[np.ndarray]:
    """Yield points (n, 3), map frame, all over the solid Gaussians near the slice."""
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
    for first, second in np.unique(counts, axis=0):
        alike = np.flatnonzero(np.all(counts == (first, second), axis=1))
        steps = [_EXTENT * ((np.arange(count) + 0.5) / count * 2.0 - 1.0) for count in (first, second)]
        grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
        grid = grid[np.linalg.norm(grid, axis=1) <= _EXTENT]
        at_once = max(_POINTS_AT_ONCE // len(grid), 1)
        for some in (alike[start : start + at_once] for start in range(0, len(alike), at_once)):
            points = centres[near][some][:, None] + np.einsum("gk,nak->nga", grid, axes[some])
            yield points.reshape(-1, 3)


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
