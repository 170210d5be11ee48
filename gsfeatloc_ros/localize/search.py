"""Where to look for the photo: at the prior, and round it if the map seen from there has nothing in common with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.localize.query import MatchedView, Query

# Matches that agree on a pose, by which a view suggests it. Chance makes some agree too: the map is looked at from the
# pose of a hint that is not strong, and has to confirm it.
MIN_HINT = 8
STRONG_HINT = 50
CONFIRMED_HINT = 12
# Views are matched with the photo at this width: it is cheap, and what it finds is refined afterwards.
SEARCH_WIDTH = 320
# Of the views that are looked at together, the best of this many are followed.
_MAX_FOLLOWED_VIEWS = 2
# Views are chosen from this many random ones for each that is looked at.
_CANDIDATES_PER_VIEW = 16
# Nothing is searched farther out than this, in standard deviations of all six coordinates together: 90 % lie within.
_MAX_DEVIATION = 3.26


def look(query: Query, poses: Sequence[np.ndarray]) -> list[MatchedView]:
    """Match a photo with views of the map and sort these by what they have in common with it.

    Args:
        query: the photo, at most SEARCH_WIDTH wide.
        poses: (4, 4) each, T_map_camera of the views.

    Returns:
        The views, those with the most inliers first.
    """
    return sorted((query.match(pose) for pose in poses), key=lambda view: view.inliers, reverse=True)


def promising(views: Sequence[MatchedView]) -> list[MatchedView]:
    """Return those of views that were looked at together and sorted whose poses of the photo are worth following."""
    return [view for view in views[:_MAX_FOLLOWED_VIEWS] if view.inliers >= MIN_HINT]


def spread_poses(
    T_map_camera: np.ndarray, covariance: np.ndarray, min_step: np.ndarray, count: int, seed: int
) -> list[np.ndarray]:
    """Choose up to `count` poses (4, 4) spread over the uncertainty (6, 6) of a pose, the likely ones first.

    Farthest-point sampling (Gonzalez, 1985) among random poses, in units of the standard deviation: no two look at
    nearly the same thing, and none at what the pose itself has shown. Of a pose that is known well there are fewer.

    Args:
        T_map_camera: (4, 4).
        covariance: (6, 6), ROS order (x y z, rotation about x y z), axes of the map frame, map units and radians.
        min_step: (6,) how far from each other poses have to be in each coordinate, all together, to show something
            else.
        count: most poses.
        seed: the same seed gives the same poses.
    """
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(_CANDIDATES_PER_VIEW * count, 6))
    normal = normal[np.linalg.norm(normal, axis=1) <= _MAX_DEVIATION]
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    root = vectors * np.sqrt(np.clip(values, 0.0, None))
    distance = np.linalg.norm(normal, axis=1)
    chosen = []
    for _ in range(min(count, len(normal))):
        farthest = int(distance.argmax())
        chosen.append(normal[farthest])
        distance = np.minimum(distance, np.linalg.norm(normal - normal[farthest], axis=1))
    chosen.sort(key=np.linalg.norm)
    steps = [np.zeros(6)]
    for step in (root @ point for point in chosen):
        if min(np.linalg.norm((step - other) / min_step) for other in steps) >= 1:
            steps.append(step)
    return [make_pose(so3_exp(step[3:]) @ T_map_camera[:3, :3], T_map_camera[:3, 3] + step[:3]) for step in steps[1:]]
