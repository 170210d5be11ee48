"""Poses of a photo by the index of views: what needs no prior."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from gsfeatloc_ros.index import ViewIndex
from gsfeatloc_ros.localize.query import Query
from gsfeatloc_ros.match.base import Features, Matches
from gsfeatloc_ros.pose.solve import Correspondences, ransac_pose

MAX_ERROR = 4.0
"""Pixels within which matches of a small photo with a view agree with a pose."""
# Samples of RANSAC: enough for one right match in eight.
_MAX_ITERATIONS = 2_000
# A view whose pose a prior holds for possible counts so many times as much as another that as much speaks for.
_WEIGHT_OF_PRIOR = 3.0
# The neighbours of a view, itself included, are looked for among so many that most speaks for.
_NEIGHBOURS = 6
_MAX_RANKED = 100


@dataclass(frozen=True, eq=False)
class Hint:
    """A pose that a view of the index suggests.

    Attributes:
        pose: (4, 4) T_map_camera of the photo.
        inliers: number of matches that agree with it.
        weight: that number, or less where the prior speaks against it.
    """

    pose: np.ndarray
    inliers: int
    weight: float


def retrieve(small: Query, likely: Callable[[np.ndarray], bool], skipped: int = 0) -> Iterator[tuple[int, Hint | None]]:
    """Yield the index's views and what each suggests, the one that most speaks for first; None where it is nothing.

    Args:
        small: the photo, at most SEARCH_WIDTH wide, and the index. It is looked for upside down and on its sides too,
            where its features are told only the same way up: nobody says which way is up in the map.
        likely: whether a prior holds a pose (4, 4) for possible; it ranks the views and forbids none.
        skipped: so many of the first views are left out.
    """
    index, features = small.components.index, small.features
    assert index is not None
    if not isinstance(features, Features):
        return

    def weight(pose: np.ndarray) -> float:
        return 1.0 if likely(pose) else 1.0 / _WEIGHT_OF_PRIOR

    turned, nearest = [features.on_host()], [small.nearest]
    for turns in (1, 2, 3) if small.components.matcher.upright else ():
        with small.clock.stage("features"):
            turned.append(_turned(small, turns))
        with small.clock.stage("search"):
            nearest.append(index.nearest(turned[-1]))
    with small.clock.stage("search"):
        weights = np.array([weight(pose) for pose in index.poses])
        votes = np.array([index.rank(found) * weights for found in nearest])
        groups = [_Group(small, index, *pair) for pair in zip(turned, np.argsort(-votes, kind="stable"), strict=True)]
    for number in np.argsort(-votes, axis=None, kind="stable")[skipped:].tolist():
        turns, view = divmod(number, len(index))
        with small.clock.stage("search"):
            hint = groups[turns].hint(view)
        if hint is None:
            yield view, None
        else:
            pose, inliers = hint
            yield view, Hint(pose, inliers, inliers * weight(pose))


def _turned(small: Query, turns: int) -> Features:
    """Return the features of the photo turned to the left by so many quarters, at the pixels of the photo as it is."""
    image = small.photo.image
    found = small.components.matcher.features(np.ascontiguousarray(np.rot90(image, turns))).on_host()
    x, y = found.keypoints.T
    right, bottom = image.shape[1] - 1, image.shape[0] - 1
    x, y = {1: (right - y, x), 2: (right - x, bottom - y), 3: (y, bottom - x)}[turns]
    return replace(found, keypoints=np.column_stack([x, y]))


class _Group:
    """A photo's matches with views of an index, and with those beside each that show the same from elsewhere.

    One view alone often has too few.
    """

    def __init__(self, small: Query, index: ViewIndex, features: Features, order: np.ndarray) -> None:
        self._small, self._index, self._features = small, index, features
        self._ranked = order[:_MAX_RANKED]
        self._matches: dict[int, tuple[Matches, np.ndarray]] = {}

    def hint(self, view: int) -> tuple[np.ndarray, int] | None:
        """Return the pose (4, 4) on which most of a view's and its neighbours' matches agree, and how many of them."""
        centres = self._index.centres
        gaps = np.linalg.norm(centres[self._ranked] - centres[view], axis=1)
        beside = self._ranked[np.argsort(gaps, kind="stable")[:_NEIGHBOURS]]
        pairs = [self._match(int(other)) for other in dict.fromkeys([view, *beside.tolist()])]
        pixels, points = np.concatenate([m.a for m, _ in pairs]), np.concatenate([p for _, p in pairs])
        found = Correspondences(pixels, points, np.zeros_like(points))
        solved = ransac_pose(
            self._small.photo.camera, found, MAX_ERROR, self._small.components.options.seed, _MAX_ITERATIONS
        )
        # A pixel that several views know counts once.
        return None if solved is None else (solved[0], len(np.unique(pixels[solved[1]], axis=0)))

    def _match(self, view: int) -> tuple[Matches, np.ndarray]:
        if view not in self._matches:
            self._matches[view] = self._index.match(self._features, view)
        return self._matches[view]
