"""The pipeline: photo and prior in, pose out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.estimate import Estimate, Status
from gsfeatloc_ros.geometry import invert, transform
from gsfeatloc_ros.match.base import Features, Matcher, Matches
from gsfeatloc_ros.pose.lift import lift
from gsfeatloc_ros.pose.solve import PoseSolution, solve_pose
from gsfeatloc_ros.render.base import Render, Renderer


@dataclass(frozen=True)
class LocalizerOptions:
    """Settings of a Localizer.

    Attributes:
        max_image_width: wider photos are resized to this many pixels first.
        max_passes: most renders that are matched: one at the prior, the others at the estimates.
        min_inliers: fewer 2D-3D matches that agree on the pose than this, in the render at the estimate, are a failure.
        min_inlier_ratio: a smaller share of inliers among the last pass's lifted matches than this is a failure.
        max_reprojection_error: pixels, of the resized photo, within which a match agrees with a pose.
        seed: of RANSAC; the same seed gives the same answer.
    """

    max_image_width: int = 640
    max_passes: int = 3
    min_inliers: int = 20
    min_inlier_ratio: float = 0.1
    max_reprojection_error: float = 3.0
    seed: int = 0


# A pass that moves what the camera sees by less than this many pixels has settled.
_SETTLED_PIXELS = 0.1
# The render at the prior, seen from elsewhere and lifted by depths that matter more the farther off it is, only has to
# suggest a pose: this few inliers do, within this many times the reprojection error. The next render is the judge.
_MIN_HINT = 8
_HINT_LOOSENESS = 2.0
# Views differ a little in what can be matched: fewer inliers than this share of the last pass's are worse.
_WORSE = 0.9


class Localizer:
    """Finds where a photo was taken: renders the map, matches, lifts to 3D, solves; then again from the estimate.

    The render at the estimate is the judge of the estimate: what the map predicts there must match the photo.
    """

    def __init__(self, renderer: Renderer, matcher: Matcher, options: LocalizerOptions | None = None) -> None:
        self._renderer = renderer
        self._matcher = matcher
        self._options = options or LocalizerOptions()

    def localize(self, image: np.ndarray, camera: Camera, T_map_camera_prior: np.ndarray) -> Estimate:
        """Localize a photo.

        Args:
            image: (H, W, 3) uint8 RGB as the camera gave it, distorted.
            camera: its intrinsics and distortion, of the same size.
            T_map_camera_prior: (4, 4) rough pose of the camera (optical axes) in the map frame.

        Raises:
            ValueError: the image is not 8-bit RGB of the camera's size, or the prior is not a finite (4, 4) pose.
        """
        if image.dtype != np.uint8 or image.shape != (camera.height, camera.width, 3):
            raise ValueError(
                f"expected an RGB image {camera.width}x{camera.height} uint8, got shape {image.shape} {image.dtype}"
            )
        if np.shape(T_map_camera_prior) != (4, 4) or not np.isfinite(T_map_camera_prior).all():
            raise ValueError("the prior must be a finite 4x4 pose")
        clock = _Clock()
        camera = camera.limited(self._options.max_image_width)
        image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        with clock.stage("features"):
            query = self._matcher.features(image)
        estimate = self._estimate(query, camera, np.asarray(T_map_camera_prior, dtype=np.float64), clock)
        return replace(estimate, milliseconds=clock.milliseconds())

    def _estimate(self, query: Features, camera: Camera, T_map_camera_prior: np.ndarray, clock: _Clock) -> Estimate:
        """Render and solve at the prior, then at each estimate, until it settles."""
        options = self._options
        best: _Pass | None = None
        pose = T_map_camera_prior
        for number in range(1, options.max_passes + 1):
            max_error = options.max_reprojection_error * (_HINT_LOOSENESS if number == 1 else 1.0)
            current = self._pass(query, camera, pose, max_error, clock)
            if number > 2 and current.inliers < _WORSE * best.inliers:
                break
            settled = number > 1 and current.solution and _moved(camera, best, current) < _SETTLED_PIXELS
            best = current
            if settled or current.inliers < _MIN_HINT:
                break
            pose = current.solution.T_map_camera

        shortage = self._shortage(query, best, "prior" if number == 1 else "estimate")
        evidence = Estimate(
            Status.FAILED, shortage, matches=best.matches, inliers=best.inliers, passes=number, last_render=best.render
        )
        if shortage:
            return evidence
        return replace(
            evidence,
            status=Status.LOCALIZED,
            reason=f"{best.inliers} inliers of {best.matches} matches after {number} passes",
            T_map_camera=best.solution.T_map_camera,
            covariance=best.solution.covariance,
            reprojection_error=best.solution.reprojection_error,
            correspondences=best.lifted_matches.select(best.solution.inliers),
        )

    def _pass(self, query: Features, camera: Camera, pose: np.ndarray, max_error: float, clock: _Clock) -> _Pass:
        """Render at `pose`, match, lift and solve."""
        with clock.stage("render"):
            render = self._renderer.render(camera, pose)
        with clock.stage("features"):
            features = self._matcher.features(render.image())
        with clock.stage("match"):
            matches = self._matcher.match(query, features)
        with clock.stage("solve"):
            lifted = lift(render, camera, pose, matches.b)
            lifted_matches = matches.select(lifted.valid)
            points = lifted.points[lifted.valid]
            solution = solve_pose(
                camera,
                camera.undistort(lifted_matches.a),
                points,
                lifted.sigmas[lifted.valid],
                max_error,
                self._options.seed,
            )
        return _Pass(render, len(matches), lifted_matches, points, solution)

    def _shortage(self, query: Features, current: _Pass, where: str) -> str:
        """What a pass has too little of to be believed, in words; "" if nothing."""
        options = self._options
        lifted = len(current.lifted_matches)
        needed = max(_MIN_HINT, options.min_inliers, int(np.ceil(options.min_inlier_ratio * lifted)))
        if current.inliers >= needed:
            return ""
        return (
            f"photo and render at the {where} do not agree: {len(query)} features, {current.matches} matches, "
            f"{lifted} with depth, {current.inliers} inliers (at least {needed} needed)"
        )


@dataclass(frozen=True, eq=False)
class _Pass:
    """One render, matched and solved.

    Attributes:
        render: the map as seen from where the pass started.
        matches: how many the matcher found.
        lifted_matches: those whose render pixel has a depth.
        points: (M, 3) map points of `lifted_matches`.
        solution: the pose from them, None where they agree on none.
    """

    render: Render
    matches: int
    lifted_matches: Matches
    points: np.ndarray
    solution: PoseSolution | None

    @property
    def inliers(self) -> int:
        return int(self.solution.inliers.sum()) if self.solution else 0


def _moved(camera: Camera, before: _Pass, after: _Pass) -> float:
    """Median distance in pixels by which the two solutions' projections of the later one's inliers differ."""
    points = after.points[after.solution.inliers]
    seen = [camera.project(transform(invert(p.solution.T_map_camera), points)) for p in (before, after)]
    return float(np.median(np.linalg.norm(seen[0] - seen[1], axis=1)))


class _Clock:
    """Adds up the wall time of named stages."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._stages: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self._stages[name] = self._stages.get(name, 0.0) + time.perf_counter() - start

    def milliseconds(self) -> dict[str, float]:
        """Milliseconds by stage, and "total" since the clock was made."""
        total = time.perf_counter() - self._start
        return {name: 1e3 * seconds for name, seconds in (self._stages | {"total": total}).items()}
