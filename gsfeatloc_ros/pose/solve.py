"""The pose of a camera from 2D-3D matches: LO-RANSAC by PoseLib, then a robust refinement with its covariance.

PoseLib was chosen over OpenCV's USAC by measurement: `python -m gsfeatloc_ros.tools.benchmark pnp`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import poselib

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose
from gsfeatloc_ros.common.parameter import parameter
from gsfeatloc_ros.pose.linear import POSE_PARAMETERS, Linear, linearize, normal_equations
from gsfeatloc_ros.pose.residual_field import MIN_PIXEL_SIGMA, ResidualField

_MIN_ITERATIONS, _MAX_ITERATIONS = 200, 10_000
# A P3P sample and one match to choose among its solutions; under-determined sets have no covariance.
MIN_POINTS = 4
_REFINE_ITERATIONS = 20
_NOISE_ITERATIONS = 4
# A pose is that of the matches where more than half of them are off by at most this many pixels.
_MAX_NEAR_ERROR = 1.0
# Poses that are not plausible are passed over, with their inliers, this many times.
_MAX_IMPLAUSIBLE_POSES = 3
# A step that lowers the cost by less than this share ends the refinement: a thousandth of a standard deviation is left.
_CONVERGED = 1e-7


@dataclass(frozen=True)
class PoseOptions:
    """How a pose is solved for.

    Attributes:
        cauchy_scale: of the robust loss, in standard deviations. Real residuals have longer tails than a Gaussian's, so
            it is narrow.
        shared_share: share of the residuals' variance that the matches of a patch of the photo have in common (errors
            of the map, of its poses, of the calibration) and that does not average out over them: docs/trust.md.
    """

    max_reprojection_error: float = parameter(
        3.0, "Pixels of the resized image within which a corner agrees with a pose.", (0.1, 50.0), live=True
    )
    cauchy_scale: float = 1.0
    shared_share: float = 1.0


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Pixels of a photo and the points of the map that are seen there.

    Attributes:
        pixels: (M, 2) undistorted.
        points: (M, 3) in the map frame.
        sigmas: (M, 3) one standard deviation of each point along the ray it was lifted on, map frame.
    """

    pixels: np.ndarray
    points: np.ndarray
    sigmas: np.ndarray

    def select(self, kept: np.ndarray) -> Correspondences:
        """Return those that a mask (M,) or indices name."""
        return Correspondences(self.pixels[kept], self.points[kept], self.sigmas[kept])

    @staticmethod
    def concatenated(parts: Sequence[Correspondences]) -> Correspondences:
        """Return those of all parts, of which there is at least one."""
        columns = zip(*((part.pixels, part.points, part.sigmas) for part in parts), strict=True)
        return Correspondences(*map(np.concatenate, columns))


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """A pose and how well the matches agree with it.

    Attributes:
        T_map_camera: (4, 4) float64.
        covariance: (6, 6) float64, ROS order (x y z, rotation about x y z), axes of the map frame.
        errors: (M,) reprojection errors of the matches in pixels.
        inliers: (M,) bool, matches within the threshold.
        reprojection_error: RMS over the inliers, pixels.
    """

    T_map_camera: np.ndarray
    covariance: np.ndarray
    errors: np.ndarray
    inliers: np.ndarray
    reprojection_error: float


def solve_pose(
    camera: Camera,
    found: Correspondences,
    options: PoseOptions,
    seed: int,
    plausible: Callable[[np.ndarray], bool] = lambda pose: True,
) -> PoseSolution | None:
    """Find the pose from which the points are seen at the pixels.

    Args:
        camera: pinhole intrinsics; its distortion is ignored.
        found: correspondences.
        options: of the solver.
        seed: of RANSAC's sampling.
        plausible: whether a pose (4, 4) may be the one that is looked for. If not, as when something in the photo is
            seen somewhere else in the map, a pose that is is looked for in the matches that do not agree with it.

    Returns:
        The solution, one that is not plausible where there is no other; None where fewer than MIN_POINTS matches agree
        on a pose.
    """
    first: PoseSolution | None = None
    others = np.arange(len(found.pixels))
    for _ in range(_MAX_IMPLAUSIBLE_POSES + 1):
        solution = _solve(camera, found, others, options, seed)
        if solution is None:
            break
        if plausible(solution.T_map_camera):
            return solution
        first = first or solution
        others = others[~solution.inliers[others]]
    return first


def solve_near(
    camera: Camera, T_map_camera: np.ndarray, found: Correspondences, options: PoseOptions
) -> PoseSolution | None:
    """Find the pose as solve_pose does, without sampling, where most matches agree with one that is known.

    No other pose can have more of them. None where a pose (4, 4) is off from most matches by more than a pixel.
    """
    errors = reprojection_errors(camera, T_map_camera, found)
    if len(errors) < MIN_POINTS or np.median(errors) > _MAX_NEAR_ERROR:
        return None
    agreeing = np.flatnonzero(errors <= options.max_reprojection_error)
    return _refined(camera, T_map_camera, found, agreeing, options)


def _solve(
    camera: Camera, found: Correspondences, among: np.ndarray, options: PoseOptions, seed: int
) -> PoseSolution | None:
    """Return the pose that most of the matches of indices `among` (N,) agree on, or None; errors are those of all."""
    sampled = ransac_pose(camera, found.select(among), options.max_reprojection_error, seed)
    if sampled is None:
        return None
    start, agreeing = sampled
    solution = _refined(camera, start, found, among[agreeing], options)
    return solution if solution and solution.inliers[among].sum() >= MIN_POINTS else None


def _refined(
    camera: Camera, start: np.ndarray, found: Correspondences, agreeing: np.ndarray, options: PoseOptions
) -> PoseSolution | None:
    """Return the pose on which matches of indices `agreeing` (N,) agree, from one near it (4, 4); errors are of all."""
    refined = refine_pose(camera, start, found.select(agreeing), options)
    if refined is None:
        return None
    errors = reprojection_errors(camera, refined[0], found)
    inliers = errors <= options.max_reprojection_error
    if inliers.sum() < MIN_POINTS:
        return None
    return PoseSolution(*refined, errors, inliers, float(np.sqrt(np.mean(errors[inliers] ** 2))))


def ransac_pose(
    camera: Camera, found: Correspondences, max_error: float, seed: int, max_iterations: int = _MAX_ITERATIONS
) -> tuple[np.ndarray, np.ndarray] | None:
    """Run LO-RANSAC with P3P: return the pose T_map_camera (4, 4) and its inliers (M,) bool, or None.

    `max_error` is the reprojection error in pixels up to which a match is an inlier, `max_iterations` the most samples
    that are drawn; the others as in `solve_pose`.
    """
    if len(found.pixels) < MIN_POINTS:
        return None
    pinhole = {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]],
    }
    ransac = {
        "max_reproj_error": max_error,
        "min_iterations": _MIN_ITERATIONS,
        "max_iterations": max_iterations,
        "seed": seed,
    }
    pose, info = poselib.estimate_absolute_pose(found.pixels, found.points, pinhole, ransac, {})
    inliers = np.asarray(info["inliers"], dtype=bool)
    T_camera_map = make_pose(pose.R, pose.t)
    if inliers.sum() < MIN_POINTS or not np.isfinite(T_camera_map).all():
        return None
    return invert(T_camera_map), inliers


def reprojection_errors(camera: Camera, T_map_camera: np.ndarray, found: Correspondences) -> np.ndarray:
    """Return the distances (M,) in pixels between the pixels and the projected points; inf behind the camera."""
    in_camera = (found.points - T_map_camera[:3, 3]) @ T_map_camera[:3, :3]
    errors = np.full(len(found.points), np.inf)
    ahead = in_camera[:, 2] > 0
    errors[ahead] = np.linalg.norm(camera.project(in_camera[ahead]) - found.pixels[ahead], axis=1)
    return errors


def refine_pose(
    camera: Camera, T_map_camera: np.ndarray, found: Correspondences, options: PoseOptions
) -> tuple[np.ndarray, np.ndarray] | None:
    """Refine a pose by Levenberg-Marquardt on the reprojection errors, whitened, with Cauchy's loss.

    A residual's covariance is the keypoints' noise, measured on the residuals, plus the projection of the point's own
    uncertainty along the ray on which it was lifted.

    Args:
        camera: pinhole intrinsics.
        T_map_camera: (4, 4) where to start.
        found: correspondences, all taken for right.
        options: of the solver.

    Returns:
        The refined pose (4, 4) and its covariance (6, 6): the inverse of the Hessian, inflated by the
        residuals' scale, and the share of errors that the matches have in common.
        None where a point falls behind the camera or the matches do not determine the pose.
    """
    from gsfeatloc_ros.pose.descent import descend

    pose, points = np.array(T_map_camera, np.float64), np.ascontiguousarray(found.points, np.float64)
    pixels, scale = np.ascontiguousarray(found.pixels, np.float64), options.cauchy_scale
    linear = linearize(camera, pose, points)
    if linear is None:
        return None
    whitening = _whitening(linear.projected - pixels, linear, found.sigmas)
    if not descend(camera.K, pose, points, pixels, whitening, scale, _REFINE_ITERATIONS, _CONVERGED):
        return None
    linear = linearize(camera, pose, points)
    assert linear is not None
    residuals = linear.projected - pixels
    equations = normal_equations(whitening, residuals, linear.by_state, POSE_PARAMETERS, scale)
    try:
        covariance = np.linalg.inv(equations.hessian)
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
        return None
    weights, by_pose = equations.weights, linear.by_state[:, :, :POSE_PARAMETERS]
    degrees_of_freedom = max(2 * weights.sum() - POSE_PARAMETERS, 1.0)
    inflation = max((weights * equations.squared).sum() / degrees_of_freedom, 1.0)
    weighted = (weights[:, None, None] * by_pose).reshape(-1, POSE_PARAMETERS)
    information_of_a_match = weighted.T @ by_pose.reshape(-1, POSE_PARAMETERS) / weights.sum()
    field = ResidualField.of(pixels, residuals, options.max_reprojection_error)
    shared = field.shared_variance(options.shared_share) * np.linalg.inv(information_of_a_match)
    return pose, covariance * inflation + shared


def whiten(
    camera: Camera, T_map_camera: np.ndarray, found: Correspondences, residuals: np.ndarray
) -> np.ndarray | None:
    """Return matrices (M, 2, 2) that whiten residuals (M, 2) at a pose (4, 4); None with points that are not ahead."""
    linear = linearize(camera, T_map_camera, found.points)
    return None if linear is None else _whitening(residuals, linear, found.sigmas)


def _whitening(residuals: np.ndarray, linear: Linear, sigmas: np.ndarray) -> np.ndarray:
    """Return matrices (M, 2, 2) that whiten residuals (M, 2) of points of these `sigmas` (M, 3)."""
    from gsfeatloc_ros.pose.kernels import whitening_matrices

    sigmas = np.ascontiguousarray(sigmas, np.float64)
    return whitening_matrices(residuals, linear.by_point, sigmas, MIN_PIXEL_SIGMA, _NOISE_ITERATIONS)
