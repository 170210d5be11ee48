"""Whether the camera is as it was calibrated: parameters of the lens and the shutter, fitted along with the pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, skew, so3_exp, so3_log
from gsfeatloc_ros.pose.solve import Correspondences, PoseOptions, shared_variance, whiten

# Parameters beside the pose: focal length (relative), k1, and by how much the camera turns, in radians about its axes,
# while the shutter runs from the first row to the last. What they are known to before a photo is seen, as standard
# deviations: what photos do not show stays near zero.
_PRIOR_SIGMAS = np.array([0.05, 0.1, 0.03, 0.03, 0.03])
# Steps are taken until what they change, in these deviations, is less than a thousandth.
_MAX_ITERATIONS = 6
_MIN_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class CameraFit:
    """How a camera differs from its calibration, by one photo.

    Attributes:
        focal: how much longer the focal length is, relative.
        focal_sigma: its standard deviation.
        k1: radial distortion (plumb_bob) that the calibration lacks.
        k1_sigma: its standard deviation.
        rolling: (3,) rotation vector of the camera, in its own axes and radians, from the first row to the last.
        rolling_sigma: (3,) its standard deviations.
        pose_shift: (6,) what the pose would be moved by, translation and rotation vector about the map's axes.
    """

    focal: float
    focal_sigma: float
    k1: float
    k1_sigma: float
    rolling: np.ndarray
    rolling_sigma: np.ndarray
    pose_shift: np.ndarray


def fit_camera(
    camera: Camera, T_map_camera: np.ndarray, found: Correspondences, options: PoseOptions
) -> CameraFit | None:
    """Fit the camera along with the pose, by Gauss-Newton on the whitened residuals with Cauchy's weights.

    The principal point is no part of it: it cannot be told from a rotation.

    Args:
        camera: as calibrated, pinhole.
        T_map_camera: (4, 4) the pose that the calibration gives.
        found: matches near that pose.
        options: of the solver.

    Returns:
        The fit; None where the matches do not determine it.
    """
    pose, extra = T_map_camera, np.zeros(len(_PRIOR_SIGMAS))
    information = np.concatenate([np.zeros(6), 1.0 / _PRIOR_SIGMAS**2])
    whitening = whiten(camera, pose, found)
    if whitening is None:
        return None
    try:
        for _ in range(_MAX_ITERATIONS):
            linear = _linearize(camera, pose, extra, found)
            if linear is None:
                return None
            system = _weigh(*linear, whitening, options)
            hessian = system.hessian + np.diag(information)
            step = -np.linalg.solve(hessian, system.gradient + information * np.concatenate([np.zeros(6), extra]))
            pose = make_pose(so3_exp(step[3:6]) @ pose[:3, :3], pose[:3, 3] + step[:3])
            extra = extra + step[6:]
            if np.abs(step[6:] / _PRIOR_SIGMAS).max() < _MIN_STEP:
                break
        sigmas = np.sqrt(np.diag(_covariance(system, information, found, options)))[6:]
    except np.linalg.LinAlgError:
        return None
    shift = np.concatenate([pose[:3, 3] - T_map_camera[:3, 3], so3_log(pose[:3, :3] @ T_map_camera[:3, :3].T)])
    if not (np.isfinite(sigmas).all() and np.isfinite(shift).all()):
        return None
    (focal, k1), (focal_sigma, k1_sigma) = extra[:2].tolist(), sigmas[:2].tolist()
    return CameraFit(focal, focal_sigma, k1, k1_sigma, extra[2:], sigmas[2:], shift)


def _covariance(system: _System, information: np.ndarray, found: Correspondences, options: PoseOptions) -> np.ndarray:
    """Return the covariance (11, 11) of pose and camera, with what the matches have in common, as of a pose."""
    size, weights = len(information), system.weights
    inflation = max((weights * system.squared).sum() / max(2 * weights.sum() - size, 1.0), 1.0)
    weighted = (weights[:, None, None] * system.jacobian).reshape(-1, size)
    of_a_match = weighted.T @ system.jacobian.reshape(-1, size) / weights.sum()
    shared = shared_variance(found.pixels, system.residuals, options)
    # What they have in common counts as one match with that error, beside what is known before.
    own = np.linalg.inv(system.hessian + np.diag(information))
    return inflation * own + np.linalg.inv(of_a_match / shared + np.diag(information))


@dataclass(frozen=True, eq=False)
class _System:
    """The robust least squares problem at a pose and camera: residuals (M, 2), Jacobians (M, 2, 11), what follows."""

    residuals: np.ndarray
    jacobian: np.ndarray
    squared: np.ndarray
    weights: np.ndarray
    hessian: np.ndarray
    gradient: np.ndarray


def _weigh(residuals: np.ndarray, jacobian: np.ndarray, whitening: np.ndarray, options: PoseOptions) -> _System:
    """Return the whitened problem with Cauchy's weights (iteratively reweighted least squares)."""
    white = np.einsum("mij,mj->mi", whitening, residuals)
    white_jacobian = whitening @ jacobian
    squared = (white**2).sum(axis=1)
    weights = 1.0 / (1.0 + squared / options.cauchy_scale**2)
    size = jacobian.shape[2]
    weighted = (weights[:, None, None] * white_jacobian).reshape(-1, size)
    hessian = weighted.T @ white_jacobian.reshape(-1, size)
    return _System(residuals, jacobian, squared, weights, hessian, weighted.T @ white.ravel())


def _linearize(
    camera: Camera, pose: np.ndarray, extra: np.ndarray, found: Correspondences
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return residuals (M, 2) and their Jacobians (M, 2, 11) by pose and camera; None with points behind the camera."""
    offsets = found.points - pose[:3, 3]
    when = ((found.pixels[:, 1] + 0.5) / camera.height - 0.5)[:, None]
    in_camera = offsets @ pose[:3, :3]
    # The camera has turned by when * rolling as the row is read: to first order, as the angles are small.
    in_camera = in_camera - np.cross(when * extra[2:], in_camera)
    z = in_camera[:, 2:]
    if not (z > 0).all():
        return None
    slopes = in_camera[:, :2] / z
    radius2 = (slopes**2).sum(axis=1, keepdims=True)
    focal = np.array([camera.K[0, 0], camera.K[1, 1]])
    bent = 1 + extra[1] * radius2
    projected = (1 + extra[0]) * focal * slopes * bent + camera.K[:2, 2]
    by_point_in_camera = np.zeros((len(found.pixels), 2, 3))
    by_point_in_camera[:, 0, 0], by_point_in_camera[:, 1, 1] = (1 + extra[0]) * focal
    by_point_in_camera[:, :, 2] = -(1 + extra[0]) * focal * slopes
    by_point_in_camera /= z[..., None]
    by_point = by_point_in_camera @ pose[:3, :3].T
    jacobian = np.concatenate(
        [
            -by_point,
            by_point @ skew(offsets),
            (focal * slopes * bent)[..., None],
            ((1 + extra[0]) * focal * slopes * radius2)[..., None],
            by_point_in_camera @ skew(in_camera) * when[..., None],
        ],
        axis=2,
    )
    return projected - found.pixels, jacobian
