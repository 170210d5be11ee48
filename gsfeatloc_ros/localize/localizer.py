"""The pipeline: photo and prior in, pose out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.localize.blur import estimate_blur
from gsfeatloc_ros.localize.comparison import changed_mask, compare
from gsfeatloc_ros.localize.estimate import Estimate, Status, Trace
from gsfeatloc_ros.localize.evidence import (
    Evidence,
    coverage,
    deviation,
    focal_length_is_wrong,
    probability_wrong,
    verdict,
)
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
from gsfeatloc_ros.pose.camera_fit import CameraFit, fit_camera
from gsfeatloc_ros.pose.solve import Correspondences
from gsfeatloc_ros.render.base import Renderer

# A render nearer to the photo than this many pixels is at the estimate.
_MAX_SETTLED_OFFSET = 0.5
# With a blur of this extent, in pixels, corners may be off by twice the reprojection error allowed.
_BLUR_THAT_DOUBLES_ERRORS = 25.0
# Matches farther off than this many pixels say nothing of the camera.
_MAX_CAMERA_ERROR = 20.0
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
        prior = _Prior(
            np.asarray(T_map_camera_prior, np.float64),
            np.asarray(prior_covariance, np.float64),
            options.prior_covariance(),
        )
        clock = StageClock(self._now, interrupted)
        with clock.stage("prepare"):
            photo = Photo.undistorted(image, camera, options.max_image_width)

        def plausible(pose: np.ndarray) -> bool:
            return prior.deviation(pose) <= options.limits.max_deviation

        trace = self._search(Query(self._components, photo, clock, plausible), prior)
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
                if not candidate.reasons_against or candidate.only_the_camera_is_wrong:
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
        with query.clock.stage("track"):
            blur = estimate_blur(query.photo.gray(), cv2.cvtColor(to_host(view.image), cv2.COLOR_RGB2GRAY))
        passes, max_passes = 1, self._components.options.max_passes
        if blur is not None and passes < max_passes:
            view = query.track(pose if view.solution is None else view.solution.T_map_camera, blur)
            passes += 1
        while (
            view.solution is not None and view.offset(query.photo.camera) >= _MAX_SETTLED_OFFSET and passes < max_passes
        ):
            view = query.track(view.solution.T_map_camera, blur)
            passes += 1
        evidence = Evidence(
            corners=len(query.tracker.corners),
            matches=view.matches,
            lifted=len(view.found.pixels),
            inliers=view.inliers,
            blur_px=blur.extent if blur else 0.0,
            passes=passes,
        )
        return self._verify(query, view, evidence, prior)

    def _verify(self, query: Query, view: MatchedView, evidence: Evidence, prior: _Prior) -> _Candidate:
        """Collect what speaks for the pose that the last view gave, and what against it."""
        options, camera = self._components.options, query.photo.camera
        if view.solution is None:
            return _Candidate(view, evidence, None, verdict(evidence, options.limits))
        # In a blurred photo all corners are less certain.
        blurred = min(evidence.blur_px / _BLUR_THAT_DOUBLES_ERRORS, 1.0)
        comparison = compare(query, view, (1.0 + blurred) * options.pose.max_reprojection_error)
        with query.clock.stage("verify"):
            pose = view.solution.T_map_camera
            fit = fit_camera(camera, pose, _near(view), options.pose)
            evidence = replace(
                evidence,
                inlier_ratio=comparison.inlier_ratio,
                render_inlier_ratio=comparison.render_inlier_ratio,
                coverage=coverage(view.correspondences.a, camera.width, camera.height),
                correlation=comparison.explained_correlation(0.5),
                low_correlation=comparison.explained_correlation(0.25),
                changed=comparison.changed_share(),
                reprojection_error_px=view.solution.reprojection_error,
                deviation=prior.deviation(pose),
                focal_error=fit.focal if fit else float("nan"),
                focal_sigma=fit.focal_sigma if fit else float("nan"),
            )
            evidence = replace(evidence, probability_wrong=probability_wrong(evidence))
            return _Candidate(view, evidence, fit, verdict(evidence, options.limits))


def _near(view: MatchedView) -> Correspondences:
    """Return the correspondences that may be right if the camera is not as it was calibrated."""
    assert view.solution is not None
    return view.found.select(view.solution.errors <= _MAX_CAMERA_ERROR)


@dataclass(frozen=True, eq=False)
class _Prior:
    """A pose (4, 4) T_map_camera with its covariance (6, 6), and that of priors which come without."""

    pose: np.ndarray
    covariance: np.ndarray
    default_covariance: np.ndarray

    def deviation(self, pose: np.ndarray) -> float:
        """Return how far a pose (4, 4) is from it in standard deviations."""
        return deviation(pose, self.pose, self.covariance, self.default_covariance)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A pose that a view gave, and whether it is an answer."""

    view: MatchedView
    evidence: Evidence
    camera_fit: CameraFit | None
    reasons_against: tuple[str, ...]

    @property
    def only_the_camera_is_wrong(self) -> bool:
        """Whether nothing but the camera's calibration speaks against it: no other view would help."""
        return len(self.reasons_against) == 1 and focal_length_is_wrong(self.evidence)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (6, 6) of the pose: what the camera's errors would move it by is part of it."""
        assert self.view.solution is not None
        shift = self.camera_fit.pose_shift if self.camera_fit else np.zeros(6)
        return self.view.solution.covariance + np.outer(shift, shift)

    def trace(self, photo: Photo, views: int) -> Trace:
        """Return the estimate that this is, after a search of `views` other views than the prior's."""
        view, evidence = self.view, replace(self.evidence, views=views)
        if self.reasons_against or view.solution is None:
            reason = f"the pose found is not believed: {self.reasons_against[0]}"
            estimate = Estimate(Status.REJECTED, reason, evidence=evidence)
        else:
            estimate = Estimate(
                Status.LOCALIZED,
                f"{evidence.inliers} inliers of {evidence.lifted} corners, correlation {evidence.correlation:.2f}; "
                f"{evidence.changed:.0%} of the photo is not as in the map",
                view.solution.T_map_camera,
                self.covariance,
                evidence,
            )
        changed = partial(changed_mask, photo, view) if view.solution else None
        return Trace(estimate, photo, view.render, view.correspondences, changed)


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
    evidence = Evidence(matches=best.matches, lifted=len(best.found.pixels), inliers=best.inliers, views=views - 1)
    reason = (
        f"photo and renders {where} have nothing in common: {features} features in the photo, at best {best.matches} "
        f"matches, {len(best.found.pixels)} with depth, {best.inliers} inliers"
    )
    return Trace(Estimate(Status.FAILED, reason, evidence=evidence), photo, best.render)
