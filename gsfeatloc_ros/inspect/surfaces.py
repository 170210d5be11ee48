"""The surfaces that small pictures show: points and normals, each place once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.index.placement import SMALL_VIEW
from gsfeatloc_ros.inspect.looks import Look

# A pixel shows a surface where it is covered so far, its depths spread over no more than this share of the depth, its
# neighbours are no farther in front of or behind each other, and it is not seen at a grazing angle (cosine).
_MIN_ALPHA = 0.9
_MAX_SPREAD = 0.15
_MAX_STEP = 0.1
_MIN_COSINE = 0.3
# Pixels to the neighbours by which a normal is found.
_REACH = 2
# A place is a cell of this share of the map's radius, and an octant of normals.
_CELL = 0.02


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points (N, 3) and unit normals (N, 3), towards where they are seen from, map frame: of each place one."""

    points: np.ndarray
    normals: np.ndarray


def find_surfaces(looks: Sequence[Look], radius: float) -> Surfaces:
    """Return the surfaces that looks show, in a map of a radius."""
    shown = [_shown(look) for look in looks] or [(np.empty((0, 3)), np.empty((0, 3)))]
    points, normals = (np.concatenate(parts) for parts in zip(*shown, strict=True))
    places = np.floor(points / (_CELL * radius)).astype(np.int64)
    octants = (normals > 0) @ np.array([1, 2, 4])
    # A hash is enough: two places that share one are a point between them, of many.
    keys = (places @ np.array([73856093, 19349663, 83492791])) * 8 + octants
    _, place, counts = np.unique(keys, return_inverse=True, return_counts=True)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.column_stack([np.bincount(place, column, len(counts)) for column in values.T]) / counts[:, None]

    directions = mean(normals)
    return Surfaces(mean(points), directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9))


def _shown(look: Look) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (n, 3) and unit normals (n, 3) of a look's pixels."""
    camera, depth = SMALL_VIEW, to_host(look.render.median_depth).astype(np.float64)
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
    points = rays.reshape(camera.height, camera.width, 3) * depth[..., None]

    def neighbours(picture: np.ndarray) -> list[np.ndarray]:
        """Of the pixels inside: those to the right, left, below and above."""
        inside, far, near = slice(_REACH, -_REACH), slice(2 * _REACH, None), slice(None, -2 * _REACH)
        return [picture[inside, far], picture[inside, near], picture[far, inside], picture[near, inside]]

    inside = np.s_[_REACH:-_REACH, _REACH:-_REACH]
    right, left, below, above = neighbours(points)
    around = np.stack(neighbours(depth))
    with np.errstate(invalid="ignore"):
        flat = (look.render.alpha[inside] > _MIN_ALPHA) & (look.render.depth_std[inside] < _MAX_SPREAD * depth[inside])
        flat &= around.max(axis=0) - around.min(axis=0) < _MAX_STEP * depth[inside]
    normals, seen = np.cross(below - above, right - left)[flat], points[inside][flat]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    cosines = -np.einsum("ij,ij->i", normals, seen) / np.linalg.norm(seen, axis=1)
    normals, seen = (values[np.abs(cosines) > _MIN_COSINE] for values in (normals * np.sign(cosines)[:, None], seen))
    rotation, position = look.pose[:3, :3], look.pose[:3, 3]
    return seen @ rotation.T + position, normals @ rotation.T
