"""Landmarks: points of the map that views show by features which look alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

# Features are of one landmark if they lie at nearly the same point of the map, by the distance from their cameras, and
# look alike.
_SAME_POINT = 0.02
_ALIKE = 0.8
# A feature is compared with so many that are nearest.
_NEIGHBOURS = 12


@dataclass(frozen=True, eq=False)
class View:
    """A view with its features that have a depth, the strongest first.

    Attributes:
        pose: (4, 4) T_map_camera.
        descriptors: (m, D) float32, of the features, of unit length.
        points: (m, 3) of the map under them.
    """

    pose: np.ndarray
    descriptors: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Landmarks, and which of them views show.

    Attributes:
        descriptors: (L, D) float32, the means of those of their features, of unit length.
        points: (L, 3), map frame, means too.
        seen: of each view the numbers (m,) of the landmarks that it shows, each once, the strongest first.
    """

    descriptors: np.ndarray
    points: np.ndarray
    seen: list[np.ndarray]

    def of_views(self, views: Sequence[int], most: int) -> Landmarks:
        """Return what is left of them for some of the views, and `most` in each of these."""
        seen = [self.seen[view][:most] for view in views]
        kept, numbers = np.unique(np.concatenate([*seen, np.zeros(0, np.int64)]), return_inverse=True)
        parts = np.split(numbers, np.cumsum([len(part) for part in seen])[:-1]) if seen else []
        return Landmarks(self.descriptors[kept], self.points[kept], parts)


def merge(views: Sequence[View]) -> Landmarks:
    """Merge the features of views to landmarks; what one view alone shows, as the texture of a haze, is left out.

    Those with the most features that are alike are made first, each with all of these that are in none yet.
    """
    if not views:
        return Landmarks(np.empty((0, 1), np.float32), np.empty((0, 3)), [])
    descriptors = np.concatenate([view.descriptors for view in views])
    points = np.concatenate([view.points for view in views])
    neighbours, alike = _alike(views, descriptors, points)
    landmark = np.full(len(points), -1)
    count = 0
    for feature in np.argsort(-alike.sum(axis=1), kind="stable"):
        others = neighbours[feature, alike[feature]]
        if landmark[feature] >= 0 or len(others) == 0:
            continue
        free = others[landmark[others] < 0]
        if len(free):
            landmark[[feature, *free]] = count
            count += 1
        else:
            landmark[feature] = landmark[others[0]]
    kept = landmark >= 0
    sums, places = np.zeros((count, descriptors.shape[1]), np.float32), np.zeros((count, 3))
    np.add.at(sums, landmark[kept], descriptors[kept])
    np.add.at(places, landmark[kept], points[kept])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    places /= np.bincount(landmark[kept], minlength=count)[:, None]
    ends = np.cumsum([0, *(len(view.points) for view in views)])
    return Landmarks(sums, places, [_distinct(landmark[start:end]) for start, end in pairwise(ends)])


def _alike(views: Sequence[View], descriptors: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest features (F, k) of each of F, and whether (F, k) another view shows the same by these."""
    if len(points) == 0:
        return np.empty((0, 1), int), np.empty((0, 1), bool)
    distances = np.concatenate([np.linalg.norm(view.points - view.pose[:3, 3], axis=1) for view in views])
    view_of = np.repeat(np.arange(len(views)), [len(view.points) for view in views])
    gaps, neighbours = cKDTree(points).query(points, k=np.arange(1, min(_NEIGHBOURS, len(points)) + 1))
    alike = (gaps < _SAME_POINT * distances[:, None]) & (view_of[neighbours] != view_of[:, None])
    feature, rank = np.nonzero(alike)
    alike[feature, rank] = (descriptors[feature] * descriptors[neighbours[feature, rank]]).sum(axis=1) > _ALIKE
    return neighbours, alike


def _distinct(landmarks: np.ndarray) -> np.ndarray:
    """Return the numbers of landmarks (m,) that are none of -1, each once, in the order in which they came first."""
    landmarks = landmarks[landmarks >= 0]
    return landmarks[np.sort(np.unique(landmarks, return_index=True)[1])]
