"""Where to look for the photo: at the prior, and elsewhere if the map seen from there has nothing in common with it."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, moved, transform
from gsfeatloc_ros.index.look_alikes import poses_elsewhere
from gsfeatloc_ros.localize.content import MIN_FEATURES
from gsfeatloc_ros.localize.evidence import Evidence
from gsfeatloc_ros.localize.prior import Prior
from gsfeatloc_ros.localize.query import MatchedView, Query
from gsfeatloc_ros.localize.reach import is_settled, is_worth_tracking, may_be_settled
from gsfeatloc_ros.localize.retrieval import MAX_ERROR, Hint, retrieve
from gsfeatloc_ros.match.base import Features
from gsfeatloc_ros.pose.solve import Correspondences, solve_pose

# Matches that agree on a pose, by which a view suggests it. Chance makes some agree too: the map is looked at from the
# pose of a hint that is not strong, and has to confirm it.
MIN_HINT = MIN_FEATURES
STRONG_HINT = 50
CONFIRMED_HINT = 12
# Views are matched with the photo at this width: it is cheap, and what it finds is refined afterwards.
SEARCH_WIDTH = 320
# Views nearer to each other than this share of the default deviations of a prior show the same.
_MIN_VIEW_STEP = 0.3
# Views are searched in batches of this many; the best of each are followed before the next is looked at.
_BATCH = 8
# Fewer matches with a view of the index suggest a pose: the map is rendered there to confirm it.
_MIN_INDEX_HINT = 6
# Of what the index suggested, so many are followed once all its views were compared.
_MAX_FOLLOWED_HINTS = 12
# Poses from which the same points are seen at least so many pixels apart are different places.
_MIN_DISTANCE_OF_RIVALS = 40.0
# Where the photo was tracked to from farther than this share of its width, it is tracked a second time.
_MAX_TRACKED_OFFSET = 0.1
# From a pose that is nearer to one that was refined tracking leads there again: pixels of a photo SEARCH_WIDTH wide.
_MIN_DISTANCE_OF_TRIES = 10.0
# Of the views that are looked at together, the best of this many are followed.
_MAX_FOLLOWED_VIEWS = 2
# Views are chosen from this many random ones for each that is looked at.
_CANDIDATES_PER_VIEW = 16
# Nothing is searched farther out than this, in standard deviations of all six coordinates together: 90 % lie within.
_MAX_DEVIATION = 3.26


class Search:
    """The search for poses of one photo that are worth a closer look.

    Args:
        query: the photo.
        prior: of its pose, None for none.
        now: clock, in seconds.

    Attributes:
        best: the view that had most in common with the photo so far; None before one was rendered.
        views: number of views, other than the prior's, that were rendered to find the photo.
        searched: number of the index's views that were compared with it.
        poses_looked_from: (4, 4) each, of all these views, the prior's included, in the order in which they were.
    """

    def __init__(self, query: Query, prior: Prior | None, now: Callable[[], float]) -> None:
        self._query, self._prior, self._now = query, prior, now
        self.best: MatchedView | None = None
        self.views = self.searched = self._around = 0
        self.poses_looked_from: list[np.ndarray] = []
        self._at_prior = False
        self._pending: list[tuple[float, int, Hint]] = []
        self._tried: list[_Place] = []

    @cached_property
    def small(self) -> Query:
        """The photo, at most SEARCH_WIDTH wide."""
        return self._query.limited(SEARCH_WIDTH)

    def tried(self, view: MatchedView) -> None:
        """Take note of what a pose led to, a view of the photo: no other pose that would lead there is yielded."""
        if view.solution is not None:
            self._tried.append(_Place.of(view))

    def poses(self) -> Iterator[np.ndarray]:
        """Yield poses (4, 4) of the photo, as long as one is asked for and views are left."""
        if self._prior is not None:
            yield from self._tracked(self._prior)
        if len(self.small.features) < MIN_FEATURES:
            return
        tracked = len(self._tried)
        found: list[Correspondences] = []
        if self._prior is not None:
            views = look(self.small, [self._prior.pose], self._prior.knows_the_way_up)
            yield from self._hints(views)
            found = [view.found for view in views]
        if self.small.components.index is not None:
            yield from self._indexed()
        # Once a pose that the prior holds for possible was refined, and is refused, others near it are no better.
        if self._prior is not None and not any(self._query.plausible(place.pose) for place in self._tried[tracked:]):
            yield from self._beside(self._prior, found)
            if not self._tried[tracked:]:
                yield from self._any_way_up(self._prior)

    @property
    def looked(self) -> str:
        """Where the photo was looked for, in words; empty for nowhere."""
        views = ["at the prior"] if self._at_prior else []
        if self._around:
            views.append(f"in {self._around} views around it")
        if self.searched:
            views.append(f"in {self.searched} of {self._index_views} views of the map")
        return " and ".join(views)

    def counted(self, evidence: Evidence) -> Evidence:
        """Return evidence with the numbers of views."""
        return replace(evidence, views=self.views, searched=self.searched, index_views=self._index_views)

    @property
    def _index_views(self) -> int:
        index = self._query.components.index
        return 0 if index is None else len(index)

    def rivals(self, found: MatchedView) -> Iterator[np.ndarray]:
        """Yield poses (4, 4), far from the one `found`, that explain the photo as well by the index and the prior."""
        index = self._query.components.index
        if index is None or found.solution is None:
            return
        camera = self.small.photo.camera
        place = _Place.of(found)
        places = [place]
        elsewhere = [motion @ place.pose for motion in index.look_alikes]
        if self.searched == 0:
            # It was found at the prior, and stands by it, unless the prior holds others for possible too.
            elsewhere = [pose for pose in elsewhere if self._likely(pose)]
        elif isinstance(self.small.features, Features):
            nearest = self.small.nearest
            with self.small.clock.stage("search"):
                elsewhere += poses_elsewhere(index, camera, nearest, place.pose)

        def is_known(pose: np.ndarray) -> bool:
            return any(known.offset(camera, pose) < _MIN_DISTANCE_OF_RIVALS for known in places)

        for hint in elsewhere:
            pose = None if is_known(hint) else self._confirmed(hint)
            if pose is not None and not is_known(pose):
                places.append(_Place(pose, place.seen))
                yield pose

    def _spread(self, prior: Prior) -> list[np.ndarray]:
        options = self.small.components.options
        min_step = _MIN_VIEW_STEP * np.sqrt(options.prior_covariance().diagonal())
        return spread_poses(prior.pose, prior.covariance, min_step, options.max_views, options.seed)

    def _beside(self, prior: Prior, found: list[Correspondences]) -> Iterator[np.ndarray]:
        """Look from around the prior and yield the poses that views suggest, alone or together.

        `found` are the matches at the prior; those of each view are added.
        """
        poses = self._spread(prior)
        for start in range(0, len(poses), _BATCH):
            batch = poses[start : start + _BATCH]
            self._around += len(batch)
            self.views += len(batch)
            self.poses_looked_from += batch
            views = look(self.small, batch, prior.knows_the_way_up)
            yield from self._hints(views)
            found += [view.found for view in views]
            yield from self._agreed(found)

    def _any_way_up(self, prior: Prior) -> Iterator[np.ndarray]:
        """Look at the prior for what it excludes and yield the pose: a camera may be mounted upside down."""
        yield from self._hints([replace(self.small, plausible=lambda pose: True).match(prior.pose, same_way_up=False)])

    def _tracked(self, prior: Prior) -> Iterator[np.ndarray]:
        """Yield the prior's pose where the photo is there, or that to which it is tracked from there.

        Only where that is likely to be cheaper than to find features.
        """
        self._at_prior = True
        self.poses_looked_from.append(prior.pose)
        full = self._query.photo.camera
        if may_be_settled(full, prior) and is_settled(self._query.render(prior.pose), full, prior):
            yield prior.pose
            if self._tried:
                return
        camera, render = self.small.photo.camera, self.small.render(prior.pose)
        if not is_worth_tracking(render, camera, prior):
            return
        view = self.small.track_from_afar(prior.pose)
        if view.solution is not None and view.offset(camera) > _MAX_TRACKED_OFFSET * camera.width:
            view = self.small.track_from_afar(view.solution.T_map_camera)
        if view.solution is not None and view.inliers >= MIN_HINT:
            yield view.solution.T_map_camera

    def _hints(self, looked: list[MatchedView]) -> Iterator[np.ndarray]:
        """Yield the poses that the best of views suggest, which were looked at together and sorted."""
        self._saw(looked[0])
        for hint in promising(looked):
            assert hint.solution is not None
            pose: np.ndarray | None = hint.solution.T_map_camera
            if hint.inliers < STRONG_HINT:
                pose = self._confirmed(hint.solution.T_map_camera)
            if pose is not None and not self._was_tried(pose):
                yield pose

    def _agreed(self, found: Sequence[Correspondences]) -> Iterator[np.ndarray]:
        """Yield the pose on which the matches of several views agree, if a render there confirms it."""
        agreed = agreed_pose(self.small, found)
        pose = None if agreed is None else self._confirmed(agreed)
        if pose is not None and not self._was_tried(pose):
            yield pose

    def _indexed(self) -> Iterator[np.ndarray]:
        """Compare the photo with the index's views and yield the poses that the best of them suggest."""
        options = self.small.components.options.search
        end = self._now() + options.max_seconds
        hints = islice(retrieve(self.small, self._likely, options.skipped), options.max_views)
        while self._compare(islice(hints, _BATCH)) and self._now() < end:
            yield from self._follow(_MAX_FOLLOWED_VIEWS, MIN_HINT)
        yield from self._follow(_MAX_FOLLOWED_HINTS, _MIN_INDEX_HINT)

    def _likely(self, pose: np.ndarray) -> bool:
        """Return whether the prior holds a pose (4, 4) for possible."""
        return self._prior is None or self._prior.deviation(pose) <= _MAX_DEVIATION

    def _compare(self, hints: Iterator[tuple[int, Hint | None]]) -> bool:
        """Take in what views of the index suggest; return whether there were any."""
        index, before = self.small.components.index, self.searched
        assert index is not None
        for view, hint in hints:
            self.searched += 1
            self.poses_looked_from.append(index.poses[view])
            if hint is not None:
                heapq.heappush(self._pending, (-hint.weight, self.searched, hint))
        return self.searched > before

    def _follow(self, count: int, min_inliers: int) -> Iterator[np.ndarray]:
        """Yield the poses of up to `count` of the strongest hints that renders there confirm."""
        for _ in range(min(count, len(self._pending))):
            if self._pending[0][2].inliers < min_inliers:
                return
            _, _, hint = heapq.heappop(self._pending)
            pose = self._confirmed(hint.pose)
            if pose is not None and not self._was_tried(pose):
                yield pose

    def _was_tried(self, pose: np.ndarray) -> bool:
        camera = self.small.photo.camera
        return any(place.offset(camera, pose) < _MIN_DISTANCE_OF_TRIES for place in self._tried)

    def _confirmed(self, pose: np.ndarray) -> np.ndarray | None:
        """Return the pose (4, 4) of the photo by a render at a suggested one; None where too little agrees."""
        if self._was_tried(pose):
            return None
        view = self.small.match(pose, same_way_up=True)
        self.views += 1
        self.poses_looked_from.append(pose)
        self._saw(view)
        return view.solution.T_map_camera if view.solution and view.inliers >= CONFIRMED_HINT else None

    def _saw(self, view: MatchedView) -> None:
        if self.best is None or view.inliers > self.best.inliers:
            self.best = view


@dataclass(frozen=True, eq=False)
class _Place:
    """A pose (4, 4), and points (N, 3) that are seen from there, in its camera frame."""

    pose: np.ndarray
    seen: np.ndarray

    @classmethod
    def of(cls, view: MatchedView) -> _Place:
        """Return the pose that a view gave, which has a solution, with what its inliers show."""
        assert view.solution is not None
        pose = view.solution.T_map_camera
        return cls(pose, transform(invert(pose), view.found.points[view.solution.inliers]))

    def offset(self, camera: Camera, pose: np.ndarray) -> float:
        """Return how far off the points are from a pose (4, 4), in pixels in the median; infinite with most behind."""
        there = transform(invert(pose) @ self.pose, self.seen)
        ahead = there[:, 2] > 0
        if ahead.sum() < 0.5 * len(self.seen):
            return float("inf")
        return float(np.median(np.linalg.norm(camera.project(there[ahead]) - camera.project(self.seen[ahead]), axis=1)))


def look(query: Query, poses: Sequence[np.ndarray], same_way_up: bool) -> list[MatchedView]:
    """Match a photo with views of the map and sort these by what they have in common with it.

    Args:
        query: the photo, at most SEARCH_WIDTH wide.
        poses: (4, 4) each, T_map_camera of the views.
        same_way_up: whether the photo is known to be the same way up as they are.

    Returns:
        The views, those with the most inliers first.
    """
    return sorted((query.match(pose, same_way_up) for pose in poses), key=lambda view: view.inliers, reverse=True)


def promising(views: Sequence[MatchedView]) -> list[MatchedView]:
    """Return those of views that were looked at together and sorted whose poses of the photo are worth following."""
    return [view for view in views[:_MAX_FOLLOWED_VIEWS] if view.inliers >= MIN_HINT]


def agreed_pose(query: Query, found: Sequence[Correspondences]) -> np.ndarray | None:
    """Return the pose (4, 4) of a photo on which matches with several views agree; None where too few do.

    Of a photo that is mostly covered, or far from all views, each alone has too few.

    Args:
        query: the photo, at most SEARCH_WIDTH wide.
        found: its matches with each view, of which there is at least one.
    """
    options, plausible = query.components.options, query.plausible
    with query.clock.stage("search"):
        together = Correspondences.concatenated(found)
        pose_options = replace(options.pose, max_reprojection_error=MAX_ERROR)
        solution = solve_pose(query.photo.camera, together, pose_options, options.seed, plausible)
    if solution is None or not plausible(solution.T_map_camera):
        return None
    # A pixel that several views know counts once.
    pixels = np.unique(together.pixels[solution.inliers], axis=0)
    return solution.T_map_camera if len(pixels) >= MIN_HINT else None


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
    steps = np.zeros((1, 6))
    for step in (root @ point for point in chosen):
        if np.linalg.norm((step - steps) / min_step, axis=1).min() >= 1:
            steps = np.vstack([steps, step])
    return [moved(T_map_camera, step) for step in steps[1:]]
