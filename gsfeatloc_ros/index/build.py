"""A view index made from a map alone, or from poses that its photos were taken at as well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.index.landmarks import View, merge
from gsfeatloc_ros.index.look_alikes import find_look_alikes
from gsfeatloc_ros.index.options import IndexOptions
from gsfeatloc_ros.index.placement import NEAR, SMALL_VIEW, VIEW, cover, overlap, radius, random_poses, seen_cells, sees
from gsfeatloc_ros.index.view_index import ViewIndex
from gsfeatloc_ros.match.base import Features, Matcher
from gsfeatloc_ros.pose.lift import LiftOptions
from gsfeatloc_ros.pose.parallax import lifting
from gsfeatloc_ros.render.base import Renderer

# Poses that are looked at small for each view that is wanted, and how many of them are looked at closely.
_CANDIDATES_PER_VIEW = 10
_SHORTLIST = 2
# Most features of a view.
_MAX_FEATURES = 225
# A view with so many landmarks is as good as one with more; no more than so many are kept.
_ENOUGH_LANDMARKS = 100
_MAX_LANDMARKS = 140
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
        options: how many views, and whether a robot on a plane looks at them.
        progress: called with the number of views looked at and of all that will be.
        interrupted: whether to give up, asked before each view.
        poses: (P, 4, 4) T_map_camera of the map's photos, if known: views are chosen to suit these.

    Raises:
        Interrupted: `interrupted` said so.
        ValueError: nothing in the map can be seen or recognized, from the camera's height if that is given, or the
            matcher has no descriptors.
    """
    rng = np.random.default_rng(options.seed)
    points = renderer.solid_points
    given = np.empty((0, 4, 4)) if poses is None else np.asarray(poses, np.float64)
    drawn, targets = random_poses(points, _CANDIDATES_PER_VIEW * options.views, rng, options)
    candidates = np.concatenate([given, drawn])
    total = len(candidates) + min(_SHORTLIST * options.views, len(candidates))

    def check(done: int) -> None:
        if interrupted():
            raise Interrupted
        progress(done, total)

    near = NEAR * radius(points)
    seen = []
    for number, pose in enumerate(candidates):
        check(number)
        render = renderer.render(SMALL_VIEW, pose)
        free = number < len(given) or sees(render, SMALL_VIEW, pose, targets[number - len(given)])
        seen.append(seen_cells(render, SMALL_VIEW, pose, near) if free else set())
    if options.on_plane and not any(seen):
        raise ValueError(
            f"nothing of the map is seen from {options.camera_height:g} above its plane z = 0: index.camera_height and "
            "index.camera_pitch are those of the camera in the aligned map"
        )
    photos = np.arange(len(candidates)) if poses is None else np.arange(len(given))
    photos = photos[:: -(-len(photos) // _MAX_PHOTOS)]
    worth = overlap([seen[photo] for photo in photos], seen)
    shortlist = cover(worth, _SHORTLIST * options.views)
    views = []
    for number, candidate in enumerate(shortlist):
        check(len(candidates) + number)
        views.append(_look(renderer, matcher, candidates[candidate]))
    landmarks = merge(views)
    quality = np.minimum([len(seen) / _ENOUGH_LANDMARKS for seen in landmarks.seen], 1.0).astype(np.float32)
    kept = cover(worth[:, shortlist] * quality, options.views)
    progress(total, total)
    poses_kept = np.array([views[view].pose for view in kept]).reshape(-1, 4, 4)
    index = ViewIndex.compress(poses_kept, landmarks.of_views(kept, _MAX_LANDMARKS))
    return replace(index, look_alikes=find_look_alikes(index, VIEW))


def _look(renderer: Renderer, matcher: Matcher, pose: np.ndarray) -> View:
    """Find and lift the features of the view at a pose (4, 4); raise ValueError where they have no descriptors."""
    render = renderer.render(VIEW, pose)
    features = matcher.features(render.device_image())
    if not isinstance(features, Features):
        raise ValueError("the matcher has no descriptors by which views could be found: use sift, xfeat or another")
    strongest = np.argsort(-to_host(features.scores))[:_MAX_FEATURES]
    lift = lifting(renderer, render, VIEW, pose, LiftOptions())
    lifted = lift(to_host(features.keypoints)[strongest].astype(np.float64))
    descriptors = to_host(features.descriptors)[strongest][lifted.valid]
    return View(pose, descriptors.astype(np.float32), lifted.points[lifted.valid])
