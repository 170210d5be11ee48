"""The pipeline: photo and prior in, pose out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.estimate import Estimate, Status
from gsfeatloc_ros.geometry import invert, so3_log, transform
from gsfeatloc_ros.match.base import Features, Matcher
from gsfeatloc_ros.pose.acceptance import agreement, coverage
from gsfeatloc_ros.render.base import Renderer
from gsfeatloc_ros.search import MIN_HINT, SEARCH_WIDTH, promising_poses, spread_poses
from gsfeatloc_ros.timing import StageClock
from gsfeatloc_ros.view import MatchedView, match_view


@dataclass(frozen=True)
class LocalizerOptions:
    """Settings of a Localizer.

    Attributes:
        max_image_width: wider photos are resized to this many pixels first.
        max_passes: most renders that are matched: one at the prior, the others at the estimates.
        max_reprojection_error: pixels, of the resized photo, within which a match agrees with a pose.
        min_inliers: fewer 2D-3D matches that agree on the pose, in the render at the estimate, reject it.
        min_inlier_ratio: as does a smaller share of inliers among the matches with a depth,
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
    max_passes: int = 3
    max_reprojection_error: float = 3.0
    min_inliers: int = 20
    min_inlier_ratio: float = 0.3
    min_coverage: float = 0.1
    min_agreement: float = 0.6
    max_deviation: float = 8.0
    max_views: int = 32
    prior_rotation: float = 15.0
    prior_translation: float = 0.5
    seed: int = 0

    def prior_covariance(self) -> np.ndarray:
        """Covariance (6, 6) of a prior that comes without one: x y z, rotation vector; map units and radians."""
        sigmas = [self.prior_translation] * 3 + [np.radians(self.prior_rotation)] * 3
        return np.diag(np.square(sigmas))


# A pass that moves what the camera sees by less than this many pixels has settled.
_SETTLED_PIXELS = 0.1
# The render at the prior is seen from elsewhere, and errors of its depth matter the more the farther off it is: there,
# matches agree with a pose within this many times the reprojection error.
_FIRST_LOOSENESS = 2.0
# Views differ a little in what can be matched: fewer inliers than this share of the last pass's are worse.
_WORSE = 0.9
# What a prior's covariance is taken to be at least, as a share of that of a prior without one.
_LEAST_SHARE_OF_USUAL = 0.01
# Views are searched in batches of this many; the best of each are followed before the next is rendered.
_BATCH = 8


class Localizer:
    """Finds where a photo was taken: renders the map, matches, lifts to 3D, solves; then again from the estimate.

    The render at the estimate is the judge of the estimate: what the map predicts there must match the photo. Where the
    prior leads to no answer, views around it are searched for a better start.
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
    ) -> Estimate:
        """Localize a photo.

        Args:
            image: (H, W, 3) uint8 RGB as the camera gave it, distorted.
            camera: its intrinsics and distortion, of the same size.
            T_map_camera_prior: (4, 4) rough pose of the camera (optical axes) in the map frame.
            prior_covariance: (6, 6) of the prior: where views are searched. In ROS order (x y z, rotation about x y z),
                axes of the map frame, map units and radians. None for that of the options.

        Raises:
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
        clock = StageClock()
        image, camera = camera.limit(image, self._options.max_image_width)
        with clock.stage("features"):
            features = self._matcher.features(image)
        prior = np.asarray(T_map_camera_prior, dtype=np.float64)
        query = _Query(image, camera, features, prior, np.asarray(prior_covariance, dtype=np.float64), clock)
        estimate = self._refine(query, prior)
        if not estimate.localized and self._options.max_views and len(features) >= MIN_HINT:
            estimate = self._search(query, estimate)
        return replace(estimate, milliseconds=clock.milliseconds())

    def _refine(self, query: _Query, pose: np.ndarray) -> Estimate:
        """Render and solve at `pose`, then at each estimate, until it settles; then judge."""
        options = self._options
        best: MatchedView | None = None
        for number in range(1, options.max_passes + 1):
            max_error = options.max_reprojection_error * (_FIRST_LOOSENESS if number == 1 else 1.0)
            current = match_view(
                self._renderer, self._matcher, query.features, query.camera, pose, max_error, options.seed, query.clock
            )
            if number > 2 and current.inliers < _WORSE * best.inliers:
                break
            settled = number > 1 and current.solution and _moved(query.camera, best, current) < _SETTLED_PIXELS
            best = current
            if settled or current.inliers < MIN_HINT:
                break
            pose = current.solution.T_map_camera
        with query.clock.stage("judge"):
            return self._judge(query, best, number)

    def _judge(self, query: _Query, view: MatchedView, passes: int) -> Estimate:
        """Believe the pose that the last view gave, or say why not."""
        options, camera = self._options, query.camera
        where = "prior" if passes == 1 else "estimate"
        counts = (
            f"{len(query.features)} features in the photo, {view.matches} matches, {len(view.points)} with depth, "
            f"{view.inliers} inliers"
        )
        evidence = Estimate(
            Status.FAILED if passes == 1 else Status.REJECTED,
            f"photo and render at the {where} have nothing in common: {counts}",
            matches=view.matches,
            inliers=view.inliers,
            passes=passes,
            last_render=view.render,
        )
        if view.inliers < MIN_HINT:
            return evidence
        pose = view.solution.T_map_camera
        evidence = replace(
            evidence,
            status=Status.REJECTED,
            coverage=coverage(view.correspondences.a, camera.width, camera.height),
            agreement=agreement(query.image, camera, view.render),
            reprojection_error=view.solution.reprojection_error,
        )
        needed = max(options.min_inliers, int(np.ceil(options.min_inlier_ratio * len(view.points))))
        deviation = query.deviation(pose, options.prior_covariance())
        doubt = ""
        if view.inliers < needed:
            doubt = f"{counts} (at least {needed} needed)"
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
            reason=f"{view.inliers} inliers of {view.matches} matches, correlation {evidence.agreement:.2f}",
            T_map_camera=pose,
            covariance=view.solution.covariance,
            correspondences=view.correspondences,
        )

    def _search(self, query: _Query, failure: Estimate) -> Estimate:
        """Start again from other views round the prior; `failure` where none of them leads to an answer."""
        options = self._options
        image, camera = query.camera.limit(query.image, SEARCH_WIDTH)
        with query.clock.stage("features"):
            features = self._matcher.features(image)
        poses = spread_poses(query.prior, query.prior_covariance, options.max_views, options.seed)
        for start in range(0, len(poses), _BATCH):
            batch = poses[start : start + _BATCH]
            for pose in promising_poses(
                self._renderer,
                self._matcher,
                features,
                camera,
                batch,
                options.max_reprojection_error,
                options.seed,
                query.clock,
            ):
                estimate = self._refine(query, pose)
                if estimate.localized:
                    return replace(estimate, views=start + len(batch))
        return replace(failure, views=len(poses))


@dataclass(frozen=True, eq=False)
class _Query:
    """What is asked: a photo (resized) with its camera and features, a prior (4, 4) with its covariance (6, 6)."""

    image: np.ndarray
    camera: Camera
    features: Features
    prior: np.ndarray
    prior_covariance: np.ndarray
    clock: StageClock

    def deviation(self, pose: np.ndarray, usual_covariance: np.ndarray) -> float:
        """Mahalanobis distance of a pose (4, 4) from the prior.

        A prior may claim to know a coordinate exactly, as RViz's planar ones do: a hundredth of the usual covariance is
        added.
        """
        step = np.concatenate([pose[:3, 3] - self.prior[:3, 3], so3_log(pose[:3, :3] @ self.prior[:3, :3].T)])
        covariance = self.prior_covariance + _LEAST_SHARE_OF_USUAL * usual_covariance
        return float(np.sqrt(max(step @ np.linalg.solve(covariance, step), 0.0)))


def _moved(camera: Camera, before: MatchedView, after: MatchedView) -> float:
    """Median distance in pixels by which the two solutions' projections of the later one's inliers differ."""
    points = after.points[after.solution.inliers]
    seen = [camera.project(transform(invert(v.solution.T_map_camera), points)) for v in (before, after)]
    return float(np.median(np.linalg.norm(seen[0] - seen[1], axis=1)))
