"""A view index made from a map alone, or from poses that its photos were taken at as well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.index.look_alikes import find_look_alikes
from gsfeatloc_ros.index.options import IndexOptions
from gsfeatloc_ros.index.placement import cover, overlap, radius, random_poses, seen_cells, sees
from gsfeatloc_ros.index.view_index import ViewIndex
from gsfeatloc_ros.match.base import Features, Matcher
from gsfeatloc_ros.pose.lift import LiftOptions, lift
from gsfeatloc_ros.render.base import Renderer

# Poses that are looked at small for each view that is wanted, and how many of them are looked at closely.
_CANDIDATES_PER_VIEW = 20
_SHORTLIST = 2
# Width, height and focal length, in pixels, of small views and of views.
_SMALL_VIEW = (80, 60, 72.0)
_VIEW = (320, 240, 288.0)
# Hardly anything may be nearer to a view than this share of the map's radius.
_NEAR = 0.02
# Most features of a view.
_MAX_FEATURES = 225
# A feature is confirmed by one of another view at nearly the same point of the map, by the distance from its camera,
# that looks alike. What is seen from one view only, as the texture of a haze, no photo shows.
_SAME_POINT = 0.02
_ALIKE = 0.75
_NEIGHBOURS = 12
# A view with so many confirmed features is as good as one with more; no more than so many are kept.
_ENOUGH_FEATURES = 100
_MAX_KEPT_FEATURES = 140
# Views are chosen to suit at most so many photos.
_MAX_PHOTOS = 5_000


def build_index(
    renderer: Renderer,
    matcher: Matcher,
    options: IndexOptions,
    progress: Callable[[int, int], None] = lambda done, total: None,
    interrupted: Callable[[], bool] = lambda: False,
    poses: np.ndarray | None = None,
) -> ViewIndex:
    """Make a view index.

    Poses among the solid Gaussians are looked from in small, as photos may be taken there. Of those that show most of
    what any of these photos shows, from about as far and from about the same side, the features are found and lifted.
    Those views are kept that suit the photos best by the features that other views confirm.

    Args:
        renderer: of the map.
        matcher: whose features the views are kept by.
        options: how many views.
        progress: called with the number of views looked at and of all that will be.
        interrupted: whether to give up, asked before each view.
        poses: (P, 4, 4) T_map_camera of the map's photos, if known: views are chosen to suit these.

    Raises:
        Interrupted: `interrupted` said so.
        ValueError: nothing in the map can be seen or recognized, or the matcher has no descriptors.
    """
    rng = np.random.default_rng(options.seed)
    points = renderer.solid_points
    given = np.empty((0, 4, 4)) if poses is None else np.asarray(poses, np.float64)
    drawn, distances = random_poses(points, _CANDIDATES_PER_VIEW * options.views, rng)
    candidates = np.concatenate([given, drawn])
    total = len(candidates) + min(_SHORTLIST * options.views, len(candidates))

    def check(done: int) -> None:
        if interrupted():
            raise Interrupted
        progress(done, total)

    small, near = _camera(*_SMALL_VIEW), _NEAR * radius(points)
    seen = []
    for number, pose in enumerate(candidates):
        check(number)
        render = renderer.render(small, pose)
        free = number < len(given) or sees(render, distances[number - len(given)])
        seen.append(seen_cells(render, small, pose, near) if free else set())
    photos = np.arange(len(candidates)) if poses is None else np.arange(len(given))
    photos = photos[:: -(-len(photos) // _MAX_PHOTOS)]
    worth = overlap([seen[photo] for photo in photos], seen)
    shortlist = cover(worth, _SHORTLIST * options.views)
    views = []
    for number, candidate in enumerate(shortlist):
        check(len(candidates) + number)
        views.append(_look(renderer, matcher, candidates[candidate]))
    _confirm(views)
    quality = np.minimum([view.confirmed.sum() / _ENOUGH_FEATURES for view in views], 1.0).astype(np.float32)
    kept = [views[view] for view in cover(worth[:, shortlist] * quality, options.views)]
    progress(total, total)
    index = ViewIndex.compress(
        np.array([view.pose for view in kept]).reshape(-1, 4, 4),
        [view.descriptors[view.confirmed] for view in kept] or [np.empty((0, 1))],
        [view.points[view.confirmed] for view in kept] or [np.empty((0, 3))],
    )
    return replace(index, look_alikes=find_look_alikes(index, _camera(*_VIEW)))


@dataclass(eq=False)
class _View:
    """A view with its features that have a depth.

    Attributes:
        pose: (4, 4) T_map_camera.
        descriptors: (m, D) of the features.
        points: (m, 3) of the map under them.
        confirmed: (m,) bool, whether another view shows the same there.
    """

    pose: np.ndarray
    descriptors: np.ndarray
    points: np.ndarray
    confirmed: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    @property
    def distances(self) -> np.ndarray:
        """Distances (m,) of the points from the camera."""
        return np.linalg.norm(self.points - self.pose[:3, 3], axis=1)


def _camera(width: int, height: int, focal_length: float) -> Camera:
    K = np.array([[focal_length, 0, (width - 1) / 2], [0, focal_length, (height - 1) / 2], [0, 0, 1]])
    return Camera(width, height, K)


def _look(renderer: Renderer, matcher: Matcher, pose: np.ndarray) -> _View:
    """Find and lift the features of the view at a pose (4, 4); raise ValueError where they have no descriptors."""
    camera = _camera(*_VIEW)
    render = renderer.render(camera, pose)
    features = matcher.features(render.device_image())
    if not isinstance(features, Features):
        raise ValueError("the matcher has no descriptors by which views could be found: use sift, xfeat or another")
    strongest = np.argsort(-to_host(features.scores))[:_MAX_FEATURES]
    lifted = lift(render, camera, pose, to_host(features.keypoints)[strongest].astype(np.float64), LiftOptions())
    descriptors = to_host(features.descriptors)[strongest][lifted.valid]
    return _View(pose, descriptors.astype(np.float32), lifted.points[lifted.valid])


def _confirm(views: list[_View]) -> None:
    """Mark the features of views that another view confirms."""
    if not views:
        return
    points, descriptors = np.concatenate([v.points for v in views]), np.concatenate([v.descriptors for v in views])
    distances = np.concatenate([view.distances for view in views])
    view_of = np.repeat(np.arange(len(views)), [len(view.points) for view in views])
    confirmed = np.zeros(len(points), bool)
    if len(points):
        near, neighbours = cKDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
        for gap, other in zip(np.atleast_2d(near.T), np.atleast_2d(neighbours.T), strict=True):
            same = (gap < _SAME_POINT * distances) & (view_of[other] != view_of)
            same[same] = (descriptors[same] * descriptors[other[same]]).sum(axis=1) > _ALIKE
            confirmed |= same
    starts = np.cumsum([len(view.points) for view in views])[:-1]
    for view, part in zip(views, np.split(confirmed, starts), strict=True):
        # The strongest come first.
        view.confirmed = part & (np.cumsum(part) <= _MAX_KEPT_FEATURES)
