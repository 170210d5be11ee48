"""Where to look for the photo: at the prior, and round it if the map seen from there has nothing in common with it."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.localize.query import MatchedView, match_view
from gsfeatloc_ros.match.base import Features, Matcher
from gsfeatloc_ros.render.base import Renderer

# Matches that agree on a pose, by which a view suggests it. Chance makes some agree too: the map is looked at from the
# pose of a hint that is not strong, and has to confirm it.
MIN_HINT = 8
STRONG_HINT = 50
CONFIRMED_HINT = 12
# Views are matched with the photo at this width: it is cheap, and what it finds is refined afterwards.
SEARCH_WIDTH = 320
# Of the views that are looked at together, the best of this many are followed.
_FOLLOWED = 2
# Views are chosen from this many random ones for each that is looked at.
_DRAWN = 16
# Nothing is searched farther out than this, in standard deviations of all six coordinates together: 90 % lie within.
_REACH = 3.26


def look(
    renderer: Renderer,
    matcher: Matcher,
    query: Features,
    camera: Camera,
    poses: list[np.ndarray],
    max_error: float,
    seed: int,
    clock: StageClock,
) -> list[MatchedView]:
    """Look at the map from `poses`, in small renders, and sort the views by what they have in common with the photo.

    Args:
        renderer, matcher: of the map and of features.
        query: features of the photo, resized to at most SEARCH_WIDTH.
        camera: of the photo at that size, without distortion.
        poses: (4, 4) each, T_map_camera of the views.
        max_error: reprojection error in pixels of the small image up to which a match agrees with a pose.
        seed: of RANSAC.
        clock: on which the stages of the views are counted.

    Returns:
        The views, those with the most inliers first.
    """
    views = [match_view(renderer, matcher, query, camera, pose, max_error, seed, clock) for pose in poses]
    return sorted(views, key=lambda view: view.inliers, reverse=True)


def promising(views: list[MatchedView]) -> list[MatchedView]:
    """Of views that were looked at together and sorted, those whose poses of the photo are worth following."""
    return [view for view in views[:_FOLLOWED] if view.inliers >= MIN_HINT]


def spread_poses(
    T_map_camera: np.ndarray, covariance: np.ndarray, apart: np.ndarray, count: int, seed: int
) -> list[np.ndarray]:
    """Choose up to `count` poses (4, 4) spread over the uncertainty (6, 6) of a pose, the likely ones first.

    Farthest-point sampling (Gonzalez, 1985) among random poses, in units of the standard deviation: no two look at
    nearly the same thing, and none at what the pose itself has shown. Of a pose that is known well there are fewer.

    Args:
        T_map_camera: (4, 4).
        covariance: (6, 6), ROS order (x y z, rotation about x y z), axes of the map frame, map units and radians.
        apart: (6,) how far from each other poses have to be in each coordinate, all together, to show something else.
        count: most poses.
        seed: the same seed gives the same poses.
    """
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(_DRAWN * count, 6))
    normal = normal[np.linalg.norm(normal, axis=1) <= _REACH]
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
        if min(np.linalg.norm((step - other) / apart) for other in steps) >= 1:
            steps.append(step)
    return [make_pose(so3_exp(step[3:]) @ T_map_camera[:3, :3], T_map_camera[:3, 3] + step[:3]) for step in steps[1:]]
