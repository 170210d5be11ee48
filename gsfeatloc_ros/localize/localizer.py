"""The pipeline: photo and prior in, pose out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.localize.estimate import Estimate, Status, Trace
from gsfeatloc_ros.localize.evidence import Evidence, correlation, coverage, deviation, inlier_ratio, verdict
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.query import Components, MatchedView, Query
from gsfeatloc_ros.localize.search import (
    CONFIRMED_HINT,
    MIN_HINT,
    SEARCH_WIDTH,
    STRONG_HINT,
    look,
    promising,
    spread_poses,
)
from gsfeatloc_ros.match import Matcher, Tracker, create_tracker
from gsfeatloc_ros.render.base import Renderer

# A render nearer to the photo than this many pixels is at the estimate.
_MAX_SETTLED_OFFSET = 0.5
# Views nearer to each other than this share of the default deviations of a prior show the same.
_MIN_VIEW_STEP = 0.3
# Views are searched in batches of this many; the best of each are followed before the next is rendered.
_BATCH = 8


class Localizer:
    """Finds where a photo was taken, in two steps.

    First features: a small render at the prior is matched with the photo, the matches are lifted to 3D by the render's
    depth and solved for the pose. Where that leads to no answer, views around the prior are tried. Then pixels: the
    photo's corners are tracked to a render at the estimate, lifted and solved, until the render is where the photo is.

    That last render is what the estimate is verified by: what the map predicts there must match the photo.
    """

    def __init__(
        self,
        renderer: Renderer,
        matcher: Matcher,
        options: LocalizerOptions | None = None,
        *,
        create_tracker: Callable[[Photo, str], Tracker] = create_tracker,
        now: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Make a localizer.

        Args:
            renderer: of the map.
            matcher: of features.
            options: settings; None for the defaults.
            create_tracker: makes the tracker of a photo for renders on a device.
            now: clock that the stages are measured with, in seconds.
        """
        self._components = Components(renderer, matcher, create_tracker, options or LocalizerOptions())
        self._now = now

    def localize(
        self,
        image: np.ndarray,
        camera: Camera,
        T_map_camera_prior: np.ndarray,
        prior_covariance: np.ndarray | None = None,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> Estimate:
        """Localize a photo.

        Args:
            image: (H, W, 3) uint8 RGB as the camera gave it, distorted.
            camera: its intrinsics and distortion, of the same size.
            T_map_camera_prior: (4, 4) prior of the camera (optical axes) in the map frame.
            prior_covariance: (6, 6) of the prior: where views are searched. In ROS order (x y z, rotation about x y z),
                axes of the map frame, map units and radians. None for that of the options.
            interrupted: whether to give up, asked every few tens of milliseconds.

        Raises:
            Interrupted: `interrupted` said so.
            ValueError: the image is not 8-bit RGB of the camera's size, the prior not a finite (4, 4) pose or its
                covariance not a finite (6, 6) matrix.
        """
        return self.trace(image, camera, T_map_camera_prior, prior_covariance, interrupted).estimate

    def trace(
        self,
        image: np.ndarray,
        camera: Camera,
        T_map_camera_prior: np.ndarray,
        prior_covariance: np.ndarray | None = None,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> Trace:
        """Localize a photo, and keep the pictures that the estimate was made from; otherwise as `localize`."""
        options = self._components.options
        if image.dtype != np.uint8 or image.shape != (camera.height, camera.width, 3):
            raise ValueError(
                f"expected an RGB image {camera.width}x{camera.height} uint8, got shape {image.shape} {image.dtype}"
            )
        if np.shape(T_map_camera_prior) != (4, 4) or not np.isfinite(T_map_camera_prior).all():
            raise ValueError("the prior must be a finite 4x4 pose")
        if prior_covariance is None:
            prior_covariance = options.prior_covariance()
        if np.shape(prior_covariance) != (6, 6) or not np.isfinite(prior_covariance).all():
            raise ValueError("the prior's covariance must be a finite 6x6 matrix")
        prior = _Prior(np.asarray(T_map_camera_prior, np.float64), np.asarray(prior_covariance, np.float64))
        clock = StageClock(self._now, interrupted)
        with clock.stage("prepare"):
            photo = Photo.undistorted(image, camera, options.max_image_width)
        trace = self._search(Query(self._components, photo, clock), prior)
        return replace(trace, estimate=replace(trace.estimate, milliseconds=clock.milliseconds()))

    def _search(self, query: Query, prior: _Prior) -> Trace:
        """Match small views of the map, first at the prior, then around it, and refine what they suggest."""
        with query.clock.stage("features"):
            small = query.limited(SEARCH_WIDTH)
            features = len(small.features)
        if features < MIN_HINT:
            reason = f"{features} features in the photo: is it too dark, too bright or out of focus?"
            return Trace(Estimate(Status.FAILED, reason), query.photo)
        views = 0
        best: MatchedView | None = None
        rejected: _Candidate | None = None
        for poses in self._batches(prior):
            looked = look(small, poses)
            views += len(looked)
            best = looked[0] if best is None else max(best, looked[0], key=lambda view: view.inliers)
            for hint in promising(looked):
                pose = _confirmed(small, hint)
                if pose is None:
                    continue
                candidate = self._refine(query, pose, prior)
                if not candidate.reasons_against:
                    return candidate.trace(query.photo, views - 1)
                rejected = rejected or candidate
        if rejected is not None:
            return rejected.trace(query.photo, views - 1)
        assert best is not None  # the prior's view is always looked at
        return _nothing_in_common(query.photo, features, best, views)

    def _batches(self, prior: _Prior) -> Iterator[list[np.ndarray]]:
        """Yield poses (4, 4) to look from: the prior alone, then those around it, a few at a time."""
        yield [prior.pose]
        options = self._components.options
        min_step = _MIN_VIEW_STEP * np.sqrt(options.prior_covariance().diagonal())
        poses = spread_poses(prior.pose, prior.covariance, min_step, options.max_views, options.seed)
        for start in range(0, len(poses), _BATCH):
            yield poses[start : start + _BATCH]

    def _refine(self, query: Query, pose: np.ndarray, prior: _Prior) -> _Candidate:
        """Render and track at `pose`, then at each estimate, until the render is where the photo is; then verify."""
        view = query.track(pose)
        passes = 1
        while (
            view.solution is not None
            and view.offset(query.photo.camera) >= _MAX_SETTLED_OFFSET
            and passes < self._components.options.max_passes
        ):
            view = query.track(view.solution.T_map_camera)
            passes += 1
        with query.clock.stage("verify"):
            return self._verify(query, view, passes, prior)

    def _verify(self, query: Query, view: MatchedView, passes: int, prior: _Prior) -> _Candidate:
        """Collect what speaks for the pose that the last view gave, and what against it."""
        options, camera = self._components.options, query.photo.camera
        evidence = Evidence(
            corners=len(query.tracker.corners),
            matches=view.matches,
            lifted=len(view.points),
            inliers=view.inliers,
            passes=passes,
        )
        if view.solution is not None:
            pose = view.solution.T_map_camera
            evidence = replace(
                evidence,
                inlier_ratio=inlier_ratio(view.solution.errors, options.pose.max_reprojection_error),
                coverage=coverage(view.correspondences.a, camera.width, camera.height),
                correlation=correlation(query.photo, view.render),
                reprojection_error_px=view.solution.reprojection_error,
                deviation=deviation(pose, prior.pose, prior.covariance, options.prior_covariance()),
            )
        return _Candidate(view, evidence, verdict(evidence, options.limits))


@dataclass(frozen=True, eq=False)
class _Prior:
    """A pose (4, 4) T_map_camera with its covariance (6, 6)."""

    pose: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A pose that a view gave, and whether it is an answer."""

    view: MatchedView
    evidence: Evidence
    reasons_against: tuple[str, ...]

    def trace(self, photo: Photo, views: int) -> Trace:
        """Return the estimate that this is, after a search of `views` other views than the prior's."""
        view, evidence = self.view, replace(self.evidence, views=views)
        if self.reasons_against or view.solution is None:
            reason = f"the pose found is not believed: {self.reasons_against[0]}"
            estimate = Estimate(Status.REJECTED, reason, evidence=evidence)
        else:
            estimate = Estimate(
                Status.LOCALIZED,
                f"{evidence.inliers} inliers of {evidence.lifted} corners, correlation {evidence.correlation:.2f}",
                view.solution.T_map_camera,
                view.solution.covariance,
                evidence,
            )
        return Trace(estimate, photo, view.render, view.correspondences)


def _confirmed(small: Query, hint: MatchedView) -> np.ndarray | None:
    """Return the pose (4, 4) of the photo that a view suggests; None where a weak hint is not confirmed from there."""
    if hint.solution is not None and hint.inliers < STRONG_HINT:
        hint = small.match(hint.solution.T_map_camera)
        if hint.inliers < CONFIRMED_HINT:
            return None
    return None if hint.solution is None else hint.solution.T_map_camera


def _nothing_in_common(photo: Photo, features: int, best: MatchedView, views: int) -> Trace:
    """None of the views, of which the first was the prior's, suggested a pose; `best` had the most inliers."""
    where = "at the prior" if views == 1 else f"at the prior and in {views - 1} views around it"
    evidence = Evidence(matches=best.matches, lifted=len(best.points), inliers=best.inliers, views=views - 1)
    reason = (
        f"photo and renders {where} have nothing in common: {features} features in the photo, at best {best.matches} "
        f"matches, {len(best.points)} with depth, {best.inliers} inliers"
    )
    return Trace(Estimate(Status.FAILED, reason, evidence=evidence), photo, best.render)
