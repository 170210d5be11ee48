"""Where to look at a map from: poses from which solid Gaussians are seen, few of which show the same."""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose, transform
from gsfeatloc_ros.index.options import IndexOptions
from gsfeatloc_ros.render.base import Render

# Cameras of views, and of those that are looked at small; hardly anything may be nearer to one than this share of the
# map's radius.
VIEW, SMALL_VIEW = Camera.centred(320, 240, 288.0), Camera.centred(80, 60, 72.0)
NEAR = 0.02
# Positions are drawn from the box of the solid Gaussians, but for a share of outliers at each end, grown by so much,
# and from these distances from them, in radii of the box.
_OUTLIERS = 1.0  # per cent
_GROWTH = 0.25
_DISTANCES = (0.1, 2.0)
# Where up is in the map's frame, by ROS's convention; if it is elsewhere, views of one thing are still turned alike.
_UP = np.array([0.0, 0.0, 1.0])
_MAX_TILT = 0.1
# Views that show so little, or of which so much is too near, are of no use.
_MIN_SEEN = 0.2
_MAX_NEAR = 0.05
# What is aimed at is seen if something is seen at its distance but for this share.
_MAX_DISTANCE_ERROR = 0.2
# Pixels by which a projection may be rounded.
_ROUNDING = 1e-6
# A pixel shows a surface where it is covered so far and its depths spread over no more than this share of the depth.
_MIN_ALPHA = 0.9
_MAX_SPREAD = 0.15
# Of a view's pixels every so many across and down are looked at.
_PIXEL_STEP = 4
# What is seen is counted in cells of this share of its distance, rounded to a power of two, and by the direction from
# which it is seen, one of so many: features look the same only from near where they were seen.
_CELL = 0.25
_DIRECTIONS = 12


def random_poses(
    points: np.ndarray, count: int, rng: np.random.Generator, options: IndexOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Draw poses (count, 4, 4), T_map_camera, each aimed at one of the points (N, 3), and these points (count, 3).

    Half of them lie anywhere in the box of the points, as cameras in rooms do; half at any distance from what they look
    at, as those round an object do. Of a robot on a plane all have the camera's height and pitch and only face what
    they are aimed at.

    Raises:
        ValueError: there is no point.
    """
    if len(points) == 0:
        raise ValueError("nothing in the map is solid: no Gaussian covers more than a half")
    low, high = _box(points)
    margin = 0.5 * _GROWTH * (high - low)
    targets = points[rng.integers(len(points), size=count)]
    inside = rng.uniform(low - margin, high + margin, (count, 3))
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    distances = radius(points) * np.exp(rng.uniform(np.log(_DISTANCES[0]), np.log(_DISTANCES[1]), (count, 1)))
    positions = np.where(rng.random((count, 1)) < 0.5, inside, targets + distances * away)
    aims = targets - positions
    if options.on_plane:
        positions[:, 2] = options.camera_height
        aims[:, 2] = np.tan(np.radians(options.camera_pitch)) * np.linalg.norm(aims[:, :2], axis=1)
    return np.array([_aimed(*pair, rng) for pair in zip(positions, aims, strict=True)]), targets


def radius(points: np.ndarray) -> float:
    """Return half of the diagonal of the box of points (N, 3), but for outliers."""
    low, high = _box(points)
    return 0.5 * float(np.linalg.norm(high - low))


def sees(render: Render, camera: Camera, T_map_camera: np.ndarray, target: np.ndarray) -> bool:
    """Return whether a view shows what it is aimed at: from behind a wall, or inside a thing, it does not.

    Args:
        render: of the view.
        camera: of the view.
        T_map_camera: (4, 4) its pose.
        target: (3,) a point of the map.
    """
    there = transform(invert(T_map_camera), target[None])
    depth = there[0, 2]
    if depth <= 0:
        return False
    # What is ahead lies between pixels: it is seen in the later of these, however it was rounded.
    x, y = np.floor(camera.project(there)[0] + 0.5 + _ROUNDING).astype(int)
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        return False
    return bool(abs(float(render.median_depth[y, x]) - depth) <= _MAX_DISTANCE_ERROR * depth)


def seen_cells(render: Render, camera: Camera, T_map_camera: np.ndarray, near: float) -> set[int]:
    """Return what a view shows, as cells; none where it is of no use.

    Args:
        render: of the view.
        camera: of the view.
        T_map_camera: (4, 4) its pose.
        near: distance within which hardly anything may be.
    """
    rows, columns = (axis.ravel() for axis in np.mgrid[2 : camera.height : _PIXEL_STEP, 2 : camera.width : _PIXEL_STEP])
    depth, spread, alpha = (
        to_host(picture)[rows, columns].astype(np.float64)
        for picture in (render.median_depth, render.depth_std, render.alpha)
    )
    surface = (alpha > _MIN_ALPHA) & (spread < _MAX_SPREAD * depth)
    if surface.mean() < _MIN_SEEN or np.mean(depth < near) > _MAX_NEAR:
        return set()
    rays = camera.rays(np.column_stack([columns, rows]).astype(np.float64)[surface])
    points = (rays * depth[surface, None]) @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]
    return cells(points, T_map_camera[:3, 3])


def cells(points: np.ndarray, centre: np.ndarray) -> set[int]:
    """Return the cells, numbered by a hash, of points (N, 3) seen from a `centre` (3,)."""
    offsets = points - centre
    distances = np.linalg.norm(offsets, axis=1)
    octaves = np.round(np.log2(np.maximum(distances, np.finfo(float).tiny)))
    grid = np.floor(points / (_CELL * 2.0**octaves)[:, None])
    directions = (offsets @ _sphere(_DIRECTIONS).T).argmax(axis=1)
    keys = np.column_stack([octaves, grid, directions]).astype(np.int64)
    return {hash(key.tobytes()) for key in keys}


def overlap(photos: Sequence[set[int]], views: Sequence[set[int]]) -> np.ndarray:
    """Return the share (P, V) float32 of the cells of each of P photos that each of V views shows as well."""
    numbers: dict[int, int] = {}

    def incidence(seen: Sequence[set[int]]) -> csr_array:
        columns = [numbers.setdefault(cell, len(numbers)) for cells_seen in seen for cell in cells_seen]
        starts = np.concatenate([[0], np.cumsum([len(cells_seen) for cells_seen in seen])])
        return csr_array((np.ones(len(columns), np.float32), columns, starts), (len(seen), max(len(numbers), 1)))

    of_photos, of_views = incidence(photos), incidence(views)
    # The views show cells that no photo does.
    of_photos.resize((len(photos), of_views.shape[1]))
    sizes = np.maximum([len(photo) for photo in photos], 1).astype(np.float32)
    return np.asarray((of_photos @ of_views.T).todense(), np.float32) / sizes[:, None]


def cover(worth: np.ndarray, count: int) -> list[int]:
    """Choose up to `count` views so that photos find one that shows much of them.

    Facility location by the greedy algorithm, evaluated lazily (Minoux, 1978); by Nemhauser et al. (1978) the sum over
    the photos is no farther than a factor of 1 - 1/e from the best.

    Args:
        worth: (P, V) what each view is worth to each photo, which takes the best; not negative.
        count: most views.
    """
    chosen: list[int] = []
    best = np.zeros(len(worth), worth.dtype)
    by_view = np.ascontiguousarray(worth.T)
    # Gains only shrink: one that is still the largest after it was computed anew is the largest of all.
    gains = [(-float(total), view) for view, total in enumerate(by_view.sum(axis=1))]
    heapq.heapify(gains)
    while gains and len(chosen) < count:
        _, view = heapq.heappop(gains)
        gain = float(np.maximum(by_view[view] - best, 0).sum())
        if gains and gain < -gains[0][0]:
            heapq.heappush(gains, (-gain, view))
        elif gain > 0:
            chosen.append(view)
            best = np.maximum(best, by_view[view])
    return chosen


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.percentile(points, [_OUTLIERS, 100 - _OUTLIERS], axis=0)
    return low, high


def _aimed(position: np.ndarray, aim: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the pose (4, 4) of a camera at `position` (3,) that looks along `aim` (3,), nearly upright."""
    z = aim / np.linalg.norm(aim) if aim.any() else np.array([1.0, 0.0, 0.0])
    x = np.cross(z, _UP + _MAX_TILT * rng.normal(size=3))
    x /= np.linalg.norm(x)
    return make_pose(np.column_stack([x, np.cross(z, x), z]), position)


def _sphere(count: int) -> np.ndarray:
    """Return `count` directions (count, 3) spread over the sphere (a Fibonacci lattice)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.column_stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])
