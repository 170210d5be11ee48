"""Residuals of matches linearized at a pose and a camera, and the normal equations of their robust problem."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsfeatloc_ros.common.camera import Camera

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
    # Not before the first pose: numba takes a second to load, and makes a folder.
    from gsfeatloc_ros.pose.kernels import linearize_points

    deviation = np.zeros(CAMERA_PARAMETERS) if deviation is None else deviation
    when = np.zeros(len(points)) if rows is None else (rows + 0.5) / camera.height - 0.5
    linear = Linear(np.empty((len(points), 2)), np.empty((len(points), 2, 11)), np.empty((len(points), 2, 3)))
    points = np.ascontiguousarray(points, np.float64)
    return linear if linearize_points(camera.K, T_map_camera, deviation, points, when, *linear) else None


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
    from gsfeatloc_ros.pose.kernels import add_up

    made = NormalEquations(
        np.zeros((parameters, parameters)), np.zeros(parameters), np.empty(len(residuals)), np.empty(len(residuals))
    )
    add_up(whitening, residuals, jacobian, cauchy_scale, *made)
    return made
