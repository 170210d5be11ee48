"""Poses of a photo by the index of views: what needs no prior."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.index import ViewIndex
from gsfeatloc_ros.localize.query import Query
from gsfeatloc_ros.match.base import Features
from gsfeatloc_ros.pose.solve import Correspondences, ransac_pose

# Matches of a small photo with a view agree with a pose within so many pixels.
_MAX_ERROR = 4.0
# A view whose pose a prior holds for possible counts so many times as much as another that as much speaks for.
_WEIGHT_OF_PRIOR = 3.0


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


def retrieve(small: Query, index: ViewIndex, likely: Callable[[np.ndarray], bool]) -> Iterator[Hint | None]:
    """Yield what each view of an index suggests, the view that most speaks for first; None where it is nothing.

    Args:
        small: the photo, at most SEARCH_WIDTH wide.
        index: to look in, of the features of the photo's matcher.
        likely: whether a prior holds a pose (4, 4) for possible; it ranks the views and forbids none.
    """
    features = small.features
    if not isinstance(features, Features):
        return
    with small.clock.stage("search"):
        found = features.on_host()
        weights = np.where([likely(pose) for pose in index.poses], 1.0, 1.0 / _WEIGHT_OF_PRIOR)
        order = np.argsort(-index.rank(found) * weights, kind="stable")
    for view in order:
        with small.clock.stage("search"):
            hint = _hint(small, index, found, view)
        if hint is None:
            yield None
        else:
            yield Hint(hint[0], hint[1], hint[1] * (1.0 if likely(hint[0]) else 1.0 / _WEIGHT_OF_PRIOR))


def _hint(small: Query, index: ViewIndex, features: Features, view: int) -> tuple[np.ndarray, int] | None:
    matches, points = index.match(features, view)
    found = Correspondences(matches.a, points, np.zeros_like(points))
    solved = ransac_pose(small.photo.camera, found, _MAX_ERROR, small.components.options.seed)
    return None if solved is None else (solved[0], int(solved[1].sum()))
