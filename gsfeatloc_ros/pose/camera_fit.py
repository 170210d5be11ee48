"""Whether the camera is as it was calibrated: parameters of the lens and the shutter, fitted along with the pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import moved
from gsfeatloc_ros.pose.linear import CAMERA_PARAMETERS, POSE_PARAMETERS, linearize, normal_equations
from gsfeatloc_ros.pose.residual_field import ResidualField
from gsfeatloc_ros.pose.solve import Correspondences, PoseOptions, whiten

# Standard deviations of the camera's parameters (pose/linear.py), each of which is zero by the calibration.
# To see whether the calibration is of this camera at all: so wide that what photos do not show stays near zero.
_ANY_CAMERA = np.array([0.05, 0.1, 0.03, 0.03, 0.03])
# How far a calibration in use is off: what the covariance allows for.
_CALIBRATED = np.array([0.002, 0.005, 0.0015, 0.0015, 0.0015])
# What the pose itself keeps to, unless the photo contradicts it. The focal length, the first of them, it keeps to in
# any case: it can hardly be told from the distance, and a calibration is better than what one photo says.
_EXACT = np.array([1e-5, 0.001, 0.0005, 0.0005, 0.0005])
_FOCAL = 0
# What a photo says of the camera is judged as if its matches were spread over a whole one: that is what the limits on
# the focal length (localize/evidence.py) were set by.
_WHOLE_PHOTO = 18.0
# Of a wall from the front nothing tells a focal length but a match that was lifted onto something else. What alone
# tells more than this share of what is known of it is left out, then what of the rest does, and so on, so many times.
_MAX_SHARE_OF_A_MATCH = 0.2
_MAX_LEFT_OUT = 3
# A few matches with wrong depths may hold a wrong focal length where it is. So steps are taken from ones that are off
# by these shares as well; where they lead to is followed if it is more likely, its logarithm by more than this.
_OTHER_FOCALS = (-0.05, 0.05)
_CLEARLY_LIKELIER = 1.0
# Steps are taken until what they change, in standard deviations, is less than a thousandth.
_MAX_ITERATIONS = 6
_MIN_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class CameraFit:
    """How a camera differs from its calibration, by one photo, and the photo's pose with that taken into account.

    Attributes:
        focal: how much longer the focal length is, relative.
        focal_sigma: its standard deviation.
        k1: radial distortion (plumb_bob) that the calibration lacks.
        k1_sigma: its standard deviation.
        rolling: (3,) rotation vector of the camera, in its own axes and radians, from the first row to the last.
        rolling_sigma: (3,) its standard deviations.
        T_map_camera: (4, 4) pose, of the middle row.
        covariance: (6, 6) of it, as that of a PoseSolution; what the camera may be off by is part of it.
        followed: (5,) of focal, k1 and rolling what the pose follows.
        field: of the residuals that pose and camera leave.
    """

    focal: float
    focal_sigma: float
    k1: float
    k1_sigma: float
    rolling: np.ndarray
    rolling_sigma: np.ndarray
    T_map_camera: np.ndarray
    covariance: np.ndarray
    followed: np.ndarray
    field: ResidualField

    def reprojection_errors(self, camera: Camera, found: Correspondences) -> np.ndarray:
        """Return the distances (M,) in pixels between pixels and points seen by this camera; inf behind it."""
        errors = np.full(len(found.pixels), np.inf)
        ahead = np.flatnonzero(_depths(camera, self.T_map_camera, self.followed, found) > np.finfo(np.float32).tiny)
        residuals, _ = _linearize(camera, _State(self.T_map_camera, self.followed), found.select(ahead))
        errors[ahead] = np.linalg.norm(residuals, axis=1)
        return errors


def fit_camera(
    camera: Camera, T_map_camera: np.ndarray, found: Correspondences, options: PoseOptions
) -> CameraFit | None:
    """Fit the camera along with the pose, by Gauss-Newton on the whitened residuals with Cauchy's weights.

    What the photo says of the camera decides how far the pose follows: a parameter's variance is what its estimate
    exceeds its own uncertainty by (empirical Bayes; automatic relevance determination, MacKay, 1994).

    The principal point is no part of it: it cannot be told from a rotation.

    Args:
        camera: as calibrated, pinhole.
        T_map_camera: (4, 4) the pose that the calibration gives.
        found: matches near that pose.
        options: of the solver.

    Returns:
        The fit; None where the matches do not determine it.
    """
    try:
        fit = _fit(camera, _State(T_map_camera, np.zeros(CAMERA_PARAMETERS)), found, options)
    except (np.linalg.LinAlgError, _BehindCameraError):
        return None
    covariance = fit.covariance
    finite = np.isfinite([fit.focal_sigma, fit.k1_sigma, *fit.rolling_sigma]).all() and np.isfinite(covariance).all()
    return fit if finite and np.linalg.eigvalsh(covariance)[0] > 0 else None


def _fit(camera: Camera, calibrated: _State, found: Correspondences, options: PoseOptions) -> CameraFit:
    problem = _Problem.seen_from(calibrated, camera, found, options)
    free = problem.most_likely(calibrated)
    # The keypoints' noise is what is left once the camera's errors are explained.
    problem = _Problem.seen_from(free, camera, found, options)
    system = problem.at(free)
    # A camera that is off leaves a smooth field as a bent map does: it must not excuse itself by that.
    unbent = replace(problem.field(system), smooth=0.0, patches=_WHOLE_PHOTO)
    sigmas = problem.camera_sigmas(system, unbent, _ANY_CAMERA)
    excess = np.sqrt(np.maximum(free.camera**2 - sigmas**2, 0.0))
    # What the photo does not contradict is as calibrated: it says more of the focal length then.
    likely = np.clip(excess, _CALIBRATED, _ANY_CAMERA)
    likely[_FOCAL] = _ANY_CAMERA[_FOCAL]
    told, telling = problem.told_by_many(calibrated, system, likely)
    focal = telling.state.camera[_FOCAL] + telling.step(likely)[POSE_PARAMETERS + _FOCAL]
    focal_sigma = told.camera_sigmas(telling, unbent, likely)[_FOCAL]
    followed = np.clip(excess, _EXACT, _ANY_CAMERA)
    followed[_FOCAL] = _EXACT[_FOCAL]
    kept = problem.solve(system, followed)
    # What a calibration in use, or one whose focal length is as far off as it reads, would move the pose by is not
    # known better than that.
    off = _CALIBRATED.copy()
    off[_FOCAL] = np.clip(np.abs(focal), _CALIBRATED[_FOCAL], _ANY_CAMERA[_FOCAL])
    system = problem.at(kept)
    shift, field = system.step(off)[:6], problem.field(system)
    return CameraFit(
        focal=float(focal),
        focal_sigma=float(focal_sigma),
        k1=float(free.camera[1]),
        k1_sigma=float(sigmas[1]),
        rolling=free.camera[2:],
        rolling_sigma=sigmas[2:],
        T_map_camera=kept.pose,
        covariance=problem.covariance(system, field, off)[:6, :6] + np.outer(shift, shift),
        followed=kept.camera,
        field=field,
    )


class _BehindCameraError(ValueError):
    """A point is not ahead of the camera."""


@dataclass(frozen=True, eq=False)
class _State:
    """A pose T_map_camera (4, 4), and the camera's parameters (5,)."""

    pose: np.ndarray
    camera: np.ndarray

    def moved(self, step: np.ndarray) -> _State:
        """Return the state after a step (11,)."""
        return _State(moved(self.pose, step[:6]), self.camera + step[6:])


@dataclass(frozen=True, eq=False)
class _System:
    """The robust least squares problem at a state: residuals (M, 2), Jacobians (M, 2, 11), and what follows.

    Deviations (5,) are standard deviations of the camera's parameters before the photo is seen.
    """

    state: _State
    residuals: np.ndarray
    jacobian: np.ndarray
    hessian: np.ndarray
    gradient: np.ndarray
    squared: np.ndarray
    weights: np.ndarray

    def step(self, deviations: np.ndarray) -> np.ndarray:
        """Return the step (11,) to the most likely state of the linearized problem."""
        information = _information(deviations)
        known = information * np.concatenate([np.zeros(POSE_PARAMETERS), self.state.camera])
        return -np.linalg.solve(self.hessian + np.diag(information), self.gradient + known)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Matches to be explained by a pose and a camera that is about as calibrated; deviations as of a _System."""

    calibrated: Camera
    found: Correspondences
    whitening: np.ndarray
    options: PoseOptions

    @classmethod
    def seen_from(cls, state: _State, camera: Camera, found: Correspondences, options: PoseOptions) -> _Problem:
        """Return the problem with the keypoints' noise as measured at a state."""
        residuals, _ = _linearize(camera, state, found)
        whitening = whiten(camera, state.pose, found, residuals)
        if whitening is None:
            raise _BehindCameraError
        return cls(camera, found, whitening, options)

    def most_likely(self, calibrated: _State) -> _State:
        """Return the most likely state of any camera, by steps from the calibrated one and from other focal lengths."""
        best = self.solve(self.at(calibrated), _ANY_CAMERA)
        least = self.loss(best)
        for error in _OTHER_FOCALS:
            start = self._zoomed(calibrated, error)
            try:
                state = self.solve(self.at(start), _ANY_CAMERA)
                loss = self.loss(state)
            except (np.linalg.LinAlgError, _BehindCameraError):
                continue
            if loss < least - _CLEARLY_LIKELIER:
                best, least = state, loss
        return best

    def _zoomed(self, calibrated: _State, error: float) -> _State:
        """Return the state with a focal length longer by this share: farther back, what it sees is as large as before.

        So it is at the median depth.
        """
        depth = np.median(_depths(self.calibrated, calibrated.pose, calibrated.camera, self.found))
        step = np.zeros(POSE_PARAMETERS + CAMERA_PARAMETERS)
        step[:3] = -error * depth * calibrated.pose[:3, 2]
        step[POSE_PARAMETERS + _FOCAL] = error
        return calibrated.moved(step)

    def told_by_many(self, calibrated: _State, system: _System, deviations: np.ndarray) -> tuple[_Problem, _System]:
        """Return the problem without matches that alone tell much of the focal length, and its most likely system.

        That of this problem is `system`.
        """
        problem = self
        for _ in range(_MAX_LEFT_OUT):
            tells_alone = problem.focal_shares(system, deviations) > _MAX_SHARE_OF_A_MATCH
            if not tells_alone.any():
                break
            kept = np.flatnonzero(~tells_alone)
            problem = replace(problem, found=problem.found.select(kept), whitening=problem.whitening[kept])
            system = problem.at(problem.most_likely(calibrated))
        return problem, system

    def focal_shares(self, system: _System, deviations: np.ndarray) -> np.ndarray:
        """Return the share (M,) of each match in what all tell of the focal length, beside the other parameters."""
        weighted = np.sqrt(system.weights)[:, None, None] * (self.whitening @ system.jacobian)
        rows, focal = weighted.reshape(-1, weighted.shape[2]), POSE_PARAMETERS + _FOCAL
        others = np.delete(rows, focal, axis=1)
        information = others.T @ others + np.diag(np.delete(_information(deviations), focal))
        alone = rows[:, focal] - others @ np.linalg.solve(information, others.T @ rows[:, focal])
        told = (alone.reshape(-1, 2) ** 2).sum(axis=1)
        return told / max(told.sum(), np.finfo(float).tiny)

    def loss(self, state: _State) -> float:
        """Return minus the logarithm of how likely a state of any camera is, but for a constant."""
        scale = self.options.cauchy_scale
        by_photo = scale**2 * np.log1p(self.at(state).squared / scale**2).sum()
        return float(0.5 * (by_photo + ((state.camera / _ANY_CAMERA) ** 2).sum()))

    def solve(self, system: _System, deviations: np.ndarray) -> _State:
        """Return the most likely state, from the problem at one near it."""
        for _ in range(_MAX_ITERATIONS):
            step = system.step(deviations)
            state = system.state.moved(step)
            if np.abs(step[6:] / _ANY_CAMERA).max() < _MIN_STEP:
                break
            system = self.at(state)
        return state

    def covariance(self, system: _System, field: ResidualField, deviations: np.ndarray) -> np.ndarray:
        """Return the covariance (11, 11) of pose and camera, with what the matches have in common, as of a pose."""
        known, weights = np.diag(_information(deviations)), system.weights
        inflation = max((weights * system.squared).sum() / max(2 * weights.sum() - len(known), 1.0), 1.0)
        weighted = (weights[:, None, None] * system.jacobian).reshape(-1, len(known))
        of_a_match = weighted.T @ system.jacobian.reshape(-1, len(known)) / weights.sum()
        shared = field.shared_variance(self.options.shared_share)
        # What they have in common counts as one match with that error, beside what is known before.
        return inflation * np.linalg.inv(system.hessian + known) + np.linalg.inv(of_a_match / shared + known)

    def camera_sigmas(self, system: _System, field: ResidualField, deviations: np.ndarray) -> np.ndarray:
        """Return the standard deviations (5,) of the camera's parameters by the photo."""
        return np.sqrt(np.maximum(np.diag(self.covariance(system, field, deviations))[POSE_PARAMETERS:], 0.0))

    def field(self, system: _System) -> ResidualField:
        """Return what the residuals have in common."""
        return ResidualField.of(self.found.pixels, system.residuals, self.options.max_reprojection_error)

    def at(self, state: _State) -> _System:
        """Return the whitened problem at a state with Cauchy's weights (iteratively reweighted least squares)."""
        residuals, jacobian = _linearize(self.calibrated, state, self.found)
        scale = self.options.cauchy_scale
        return _System(
            state, residuals, jacobian, *normal_equations(self.whitening, residuals, jacobian, jacobian.shape[2], scale)
        )


def _information(deviations: np.ndarray) -> np.ndarray:
    """Return what is known (11,) of pose and camera before the photo is seen."""
    return np.concatenate([np.zeros(POSE_PARAMETERS), 1.0 / deviations**2])


def _depths(camera: Camera, pose: np.ndarray, deviation: np.ndarray, found: Correspondences) -> np.ndarray:
    """Return the depths (M,) of the points as their rows are read: the camera has turned by then, by small angles."""
    in_camera = (found.points - pose[:3, 3]) @ pose[:3, :3]
    when = (found.pixels[:, 1] + 0.5) / camera.height - 0.5
    return in_camera[:, 2] - when * np.cross(deviation[2:], in_camera)[:, 2]


def _linearize(camera: Camera, state: _State, found: Correspondences) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (M, 2) and their Jacobians (M, 2, 11) by pose and camera; raise _BehindCameraError."""
    linear = linearize(camera, state.pose, found.points, state.camera, found.pixels[:, 1])
    if linear is None:
        raise _BehindCameraError
    return linear.projected - found.pixels, linear.by_state
