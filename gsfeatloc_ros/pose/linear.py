"""Residuals of matches linearized at a pose and a camera, and the normal equations of their robust problem.

Kernels take as many parameters as they need: common/kernels.py says why.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.kernels import njit

POSE_PARAMETERS = 6
"""Translation and rotation of the pose, which moves as t + dt, exp(dr) R, both in the map frame."""
CAMERA_PARAMETERS = 5
"""Focal length (relative), k1, and by how much the camera turns, in radians about its axes, while a rolling shutter
runs from the first row to the last."""


class Linear(NamedTuple):
    """Pixels at which points are seen, and their Jacobians.

    Attributes:
        projected: (M, 2).
        by_state: (M, 2, 11) by pose and camera.
        by_point: (M, 2, 3) by the point, map frame.
    """

    projected: np.ndarray
    by_state: np.ndarray
    by_point: np.ndarray


class NormalEquations(NamedTuple):
    """The quadratic model of a Cauchy-weighted problem (iteratively reweighted least squares) in N parameters.

    Attributes:
        hessian: (N, N).
        gradient: (N,).
        squared: (M,) squared lengths of the whitened residuals.
        weights: (M,) of the residuals.
    """

    hessian: np.ndarray
    gradient: np.ndarray
    squared: np.ndarray
    weights: np.ndarray


def linearize(
    camera: Camera,
    T_map_camera: np.ndarray,
    points: np.ndarray,
    deviation: np.ndarray | None = None,
    rows: np.ndarray | None = None,
) -> Linear | None:
    """Project points (M, 3) of the map, and differentiate that by pose, camera and point.

    Args:
        camera: as calibrated, pinhole.
        T_map_camera: (4, 4).
        points: as above.
        deviation: (5,) of the camera from its calibration, see CAMERA_PARAMETERS; None for none. By small angles: how
            the turn of the camera moves what else depends on the point is left out.
        rows: (M,) of the pixels, by which a rolling shutter is timed; None where all are read at once.

    Returns:
        The pixels and their Jacobians; None where a point is not ahead of the camera.
    """
    deviation = np.zeros(CAMERA_PARAMETERS) if deviation is None else deviation
    when = np.zeros(len(points)) if rows is None else (rows + 0.5) / camera.height - 0.5
    linear = Linear(np.empty((len(points), 2)), np.empty((len(points), 2, 11)), np.empty((len(points), 2, 3)))
    points = np.ascontiguousarray(points, np.float64)
    return linear if _linearize(camera.K, T_map_camera, deviation, points, when, *linear) else None


def normal_equations(
    whitening: np.ndarray, residuals: np.ndarray, jacobian: np.ndarray, parameters: int, cauchy_scale: float
) -> NormalEquations:
    """Return the normal equations of residuals (M, 2), each whitened by its matrix, with the weights of Cauchy's loss.

    Args:
        whitening: (M, 2, 2).
        residuals: as above.
        jacobian: (M, 2, 11).
        parameters: how many of them, the first ones, are solved for.
        cauchy_scale: of the loss, in standard deviations.
    """
    made = NormalEquations(
        np.zeros((parameters, parameters)), np.zeros(parameters), np.empty(len(residuals)), np.empty(len(residuals))
    )
    _add_up(whitening, residuals, jacobian, cauchy_scale, *made)
    return made


@njit(cache=True, nogil=True, error_model="numpy")
def _linearize(K, pose, deviation, points, when, projected, by_state, by_point):
    """Fill in a Linear; return whether all points are ahead."""
    by_camera_point = np.zeros((2, 3))
    longer = 1.0 + deviation[0]
    for match in range(len(points)):
        x, y, z = points[match, 0] - pose[0, 3], points[match, 1] - pose[1, 3], points[match, 2] - pose[2, 3]
        a = pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z
        b = pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z
        c = pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z
        turn_a, turn_b, turn_c = when[match] * deviation[2], when[match] * deviation[3], when[match] * deviation[4]
        a, b, c = a - (turn_b * c - turn_c * b), b - (turn_c * a - turn_a * c), c - (turn_a * b - turn_b * a)
        if not c > 0:
            return False
        right, down = a / c, b / c
        radius2 = right * right + down * down
        bent = 1.0 + deviation[1] * radius2
        for axis in range(2):
            # A calibrated pixel less the principal point.
            along = K[axis, 0] * right + K[axis, 1] * down
            projected[match, axis] = longer * bent * along + K[axis, 2]
            # The quotient rule; how k1 changes with the point is left out: it is small.
            by_camera_point[axis, 0] = longer * K[axis, 0] / c
            by_camera_point[axis, 1] = longer * K[axis, 1] / c
            by_camera_point[axis, 2] = -longer * along / c
            u, v, w = by_camera_point[axis]
            for row in range(3):
                by_point[match, axis, row] = u * pose[row, 0] + v * pose[row, 1] + w * pose[row, 2]
            p, q, r = by_point[match, axis]
            state = by_state[match, axis]
            state[0], state[1], state[2] = -p, -q, -r
            state[3], state[4], state[5] = q * z - r * y, r * x - p * z, p * y - q * x
            state[6] = along * bent
            state[7] = longer * along * radius2
            state[8], state[9], state[10] = v * c - w * b, w * a - u * c, u * b - v * a
            state[8:] *= when[match]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _add_up(whitening, residuals, jacobian, cauchy_scale, hessian, gradient, squared, weights):
    """Fill in NormalEquations, whose Hessian and gradient are zero."""
    count = len(gradient)
    white = np.empty((2, count))
    for match in range(len(residuals)):
        W, residual = whitening[match], residuals[match]
        first = W[0, 0] * residual[0] + W[0, 1] * residual[1]
        second = W[1, 0] * residual[0] + W[1, 1] * residual[1]
        squared[match] = first * first + second * second
        weight = 1.0 / (1.0 + squared[match] / cauchy_scale**2)
        weights[match] = weight
        for i in range(count):
            white[0, i] = W[0, 0] * jacobian[match, 0, i] + W[0, 1] * jacobian[match, 1, i]
            white[1, i] = W[1, 0] * jacobian[match, 0, i] + W[1, 1] * jacobian[match, 1, i]
        for i in range(count):
            first_weighted, second_weighted = weight * white[0, i], weight * white[1, i]
            gradient[i] += first_weighted * first + second_weighted * second
            for j in range(i + 1):
                hessian[i, j] += first_weighted * white[0, j] + second_weighted * white[1, j]
    for i in range(count):
        for j in range(i):
            hessian[j, i] = hessian[i, j]
