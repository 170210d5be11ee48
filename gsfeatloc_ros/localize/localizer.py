"""The pipeline: photo and prior in, pose out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import so3_log
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.localize.evidence import agreeing_share, agreement, coverage
from gsfeatloc_ros.localize.query import MatchedView, track_view
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


@dataclass(frozen=True)
class LocalizerOptions:
    """Settings of a Localizer.

    Attributes:
        max_image_width: wider photos are resized to this many pixels first.
        max_passes: most renders at estimates to which the photo is tracked.
        max_reprojection_error: pixels, of the resized photo, within which a corner agrees with a pose.
        min_inliers: fewer of the photo's corners that agree on the pose, in the render at the estimate, reject it.
        min_inlier_ratio: as does a smaller share that agrees, of the corners that were found and have a depth,
        min_coverage: inliers in a smaller share of the photo's cells (8 x 6),
        min_agreement: or a smaller correlation of the photo with the render at the estimate.
        max_deviation: as does a pose farther from the prior than this many standard deviations of it: a mirror image,
            or a wall seen from behind, can match well.
        max_views: most other views round the prior that are searched when it leads to no answer; 0 for none.
        prior_rotation: standard deviation of a prior that comes without covariance, in degrees about each axis.
        prior_translation: the same in map units along each axis.
        seed: of RANSAC and of the search; the same seed gives the same answer.
    """

    max_image_width: int = 640
    max_passes: int = 4
    max_reprojection_error: float = 3.0
    min_inliers: int = 20
    min_inlier_ratio: float = 0.94
    min_coverage: float = 0.1
    min_agreement: float = 0.3
    max_deviation: float = 8.0
    max_views: int = 32
    prior_rotation: float = 15.0
    prior_translation: float = 0.5
    seed: int = 0

    def prior_covariance(self) -> np.ndarray:
        """Covariance (6, 6) of a prior that comes without one: x y z, rotation vector; map units and radians."""
        sigmas = [self.prior_translation] * 3 + [np.radians(self.prior_rotation)] * 3
        return np.diag(np.square(sigmas))


# A render nearer to the photo than this many pixels is at the estimate.
_SETTLED_PIXELS = 0.5
# What a prior's covariance is taken to be at least, as a share of that of a prior without one.
_LEAST_SHARE_OF_USUAL = 0.01
# Views nearer to each other than this share of the usual deviations of a prior show the same.
_APART = 0.3
# Views are searched in batches of this many; the best of each are followed before the next is rendered.
_BATCH = 8


class Localizer:
    """Finds where a photo was taken, in two steps.

    First features: a small render at the prior is matched with the photo, the matches are lifted to 3D by the render's
    depth and solved for the pose. Where that leads to no answer, views around the prior are tried. Then pixels: the
    photo's corners are tracked to a render at the estimate, lifted and solved, until the render is where the photo is.

    That last render is the judge of the estimate: what the map predicts there must match the photo.
    """

    def __init__(self, renderer: Renderer, matcher: Matcher, options: LocalizerOptions | None = None) -> None:
        self._renderer = renderer
        self._matcher = matcher
        self._options = options or LocalizerOptions()

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
            T_map_camera_prior: (4, 4) rough pose of the camera (optical axes) in the map frame.
            prior_covariance: (6, 6) of the prior: where views are searched. In ROS order (x y z, rotation about x y z),
                axes of the map frame, map units and radians. None for that of the options.
            interrupted: whether to give up, asked every few tens of milliseconds.

        Raises:
            Interrupted: `interrupted` said so.
            ValueError: the image is not 8-bit RGB of the camera's size, the prior not a finite (4, 4) pose or its
                covariance not a finite (6, 6) matrix.
        """
        if image.dtype != np.uint8 or image.shape != (camera.height, camera.width, 3):
            raise ValueError(
                f"expected an RGB image {camera.width}x{camera.height} uint8, got shape {image.shape} {image.dtype}"
            )
        if np.shape(T_map_camera_prior) != (4, 4) or not np.isfinite(T_map_camera_prior).all():
            raise ValueError("the prior must be a finite 4x4 pose")
        if prior_covariance is None:
            prior_covariance = self._options.prior_covariance()
        if np.shape(prior_covariance) != (6, 6) or not np.isfinite(prior_covariance).all():
            raise ValueError("the prior's covariance must be a finite 6x6 matrix")
        clock = StageClock(interrupted=interrupted)
        with clock.stage("prepare"):
            photo = Photo.undistorted(image, camera, self._options.max_image_width)
        prior = np.asarray(T_map_camera_prior, dtype=np.float64)
        query = _Query(photo, prior, np.asarray(prior_covariance, dtype=np.float64), self._renderer.device, clock)
        return replace(self._search(query), milliseconds=clock.milliseconds())

    def _search(self, query: _Query) -> Estimate:
        """Match small views of the map, first at the prior, then around it, and refine what they suggest."""
        options, clock = self._options, query.clock
        with clock.stage("features"):
            small = query.photo.limited(SEARCH_WIDTH)
            features = self._matcher.features(small.image)
        if len(features) < MIN_HINT:
            return Estimate(
                Status.FAILED, f"{len(features)} features in the photo: is it too dark, too bright or out of focus?"
            )

        def look_from(poses: list[np.ndarray]) -> list[MatchedView]:
            max_error, seed = options.max_reprojection_error, options.seed
            return look(self._renderer, self._matcher, features, small.camera, poses, max_error, seed, clock)

        views, best = 0, None
        rejected: Estimate | None = None
        for batch in self._batches(query):
            looked = look_from(batch)
            views += len(looked)
            best = max(filter(None, (best, looked[0])), key=lambda view: view.inliers)
            for view in promising(looked):
                if view.inliers < STRONG_HINT:
                    view = look_from([view.solution.T_map_camera])[0]
                    if view.inliers < CONFIRMED_HINT:
                        continue
                estimate = self._refine(query, view.solution.T_map_camera)
                if estimate.localized:
                    return replace(estimate, views=views - 1)
                rejected = rejected or estimate
        return replace(rejected or _nothing_in_common(len(features), best, views), views=views - 1)

    def _batches(self, query: _Query) -> Iterator[list[np.ndarray]]:
        """Poses (4, 4) to look from: the prior alone, then those around it, a few at a time."""
        yield [query.prior]
        options = self._options
        apart = _APART * np.sqrt(options.prior_covariance().diagonal())
        poses = spread_poses(query.prior, query.prior_covariance, apart, options.max_views, options.seed)
        for start in range(0, len(poses), _BATCH):
            yield poses[start : start + _BATCH]

    def _refine(self, query: _Query, pose: np.ndarray) -> Estimate:
        """Render and track at `pose`, then at each estimate, until the render is where the photo is; then judge."""
        options, camera = self._options, query.photo.camera
        passes, settled = 0, False
        while passes < options.max_passes and not settled:
            view = track_view(
                self._renderer, query.tracker, camera, pose, options.max_reprojection_error, options.seed, query.clock
            )
            passes += 1
            if view.solution is None:
                break
            settled = view.offset(camera) < _SETTLED_PIXELS
            pose = view.solution.T_map_camera
        with query.clock.stage("judge"):
            return self._judge(query, view, passes)

    def _judge(self, query: _Query, view: MatchedView, passes: int) -> Estimate:
        """Believe the pose that the last view gave, or say why not."""
        options, camera = self._options, query.photo.camera
        counts = (
            f"{len(query.tracker.corners)} corners in the photo, {view.matches} found in the render, "
            f"{len(view.points)} with depth, {view.inliers} inliers"
        )
        evidence = Estimate(
            Status.REJECTED,
            f"the pose found is not believed: photo and render at the estimate have nothing in common: {counts}",
            matches=view.matches,
            inliers=view.inliers,
            passes=passes,
            last_render=view.render,
        )
        if view.solution is None:
            return evidence
        pose = view.solution.T_map_camera
        evidence = replace(
            evidence,
            inlier_ratio=agreeing_share(view.solution.errors, options.max_reprojection_error),
            coverage=coverage(view.correspondences.a, camera.width, camera.height),
            agreement=agreement(query.photo, view.render),
            reprojection_error=view.solution.reprojection_error,
            correspondences=view.correspondences,
        )
        deviation = query.deviation(pose, options.prior_covariance())
        doubt = ""
        if view.inliers < options.min_inliers:
            doubt = f"{counts} (at least {options.min_inliers} needed)"
        elif evidence.inlier_ratio < options.min_inlier_ratio:
            doubt = f"{counts}: a share of {evidence.inlier_ratio:.2f} (at least {options.min_inlier_ratio:g} needed)"
        elif evidence.coverage < options.min_coverage:
            doubt = f"inliers in {evidence.coverage:.0%} of the photo (at least {options.min_coverage:.0%} needed)"
        elif not evidence.agreement >= options.min_agreement:
            doubt = f"correlation {evidence.agreement:.2f} (at least {options.min_agreement:g} needed)"
        elif deviation > options.max_deviation:
            doubt = (
                f"the pose is {deviation:.1f} standard deviations from the prior (at most {options.max_deviation:g})"
            )
        if doubt:
            return replace(evidence, reason=f"the pose found is not believed: {doubt}")
        return replace(
            evidence,
            status=Status.LOCALIZED,
            reason=f"{view.inliers} inliers of {len(view.points)} corners, correlation {evidence.agreement:.2f}",
            T_map_camera=pose,
            covariance=view.solution.covariance,
        )


@dataclass(frozen=True, eq=False)
class _Query:
    """What is asked: a photo, a prior (4, 4) with its covariance (6, 6); `device` is the renderer's."""

    photo: Photo
    prior: np.ndarray
    prior_covariance: np.ndarray
    device: str
    clock: StageClock

    @cached_property
    def tracker(self) -> Tracker:
        """Of the photo; made when there is an estimate to track from."""
        with self.clock.stage("track"):
            return create_tracker(self.photo, self.device)

    def deviation(self, pose: np.ndarray, usual_covariance: np.ndarray) -> float:
        """Mahalanobis distance of a pose (4, 4) from the prior.

        A prior may claim to know a coordinate exactly, as RViz's planar ones do: a hundredth of the usual covariance is
        added.
        """
        step = np.concatenate([pose[:3, 3] - self.prior[:3, 3], so3_log(pose[:3, :3] @ self.prior[:3, :3].T)])
        # In units of the usual deviations; what is no covariance (correlations beyond 1) opens no gate.
        unit = np.sqrt(usual_covariance.diagonal())
        values, vectors = np.linalg.eigh(0.5 * (self.prior_covariance + self.prior_covariance.T) / np.outer(unit, unit))
        variances = np.clip(values, 0.0, None) + _LEAST_SHARE_OF_USUAL
        return float(np.linalg.norm(vectors.T @ (step / unit) / np.sqrt(variances)))


def _nothing_in_common(features: int, best: MatchedView, views: int) -> Estimate:
    """None of the views, of which the first was the prior's, suggested a pose; `best` had the most inliers."""
    where = "at the prior" if views == 1 else f"at the prior and in {views - 1} views around it"
    return Estimate(
        Status.FAILED,
        f"photo and renders {where} have nothing in common: {features} features in the photo, at best {best.matches} "
        f"matches, {len(best.points)} with depth, {best.inliers} inliers",
        matches=best.matches,
        inliers=best.inliers,
        last_render=best.render,
    )
