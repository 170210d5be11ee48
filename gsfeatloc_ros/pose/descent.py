"""The pose of least loss near another, by compiled steps: in Python, each would take longer than what it computes."""

# Kernels take as many parameters as they need: common/kernels.py says why.

from __future__ import annotations

import math

import numpy as np

from gsfeatloc_ros.common.kernels import njit
from gsfeatloc_ros.pose.kernels import add_up, linearize_points

# Radians under which the series of sine and cosine are more exact.
_SMALL_ANGLE = 1e-6


@njit(cache=True, nogil=True, error_model="numpy")
def descend(K, pose, points, pixels, whitening, cauchy_scale, max_steps, min_decrease):
    """Move a pose (4, 4), in place, to where Cauchy's loss of whitened residuals is least, by Levenberg-Marquardt.

    A step that lowers the loss by less than the share `min_decrease` is the last. Return whether the matches determine
    the pose; from where it is at first, all points are ahead.
    """
    count = len(points)
    exact, at_once = np.zeros(5), np.zeros(count)
    projected, by_state, by_point = np.empty((count, 2)), np.empty((count, 2, 11)), np.empty((count, 2, 3))
    squared, weights = np.empty(count), np.empty(count)
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    there, step = pose.copy(), np.zeros(6)
    loss, damping = np.inf, 1e-3
    # At first where it is, without a step.
    for taken in range(max_steps + 1):
        loss_there = np.inf
        hessian_there, gradient_there = np.zeros((6, 6)), np.zeros(6)
        if linearize_points(K, there, exact, points, at_once, projected, by_state, by_point):
            projected -= pixels
            add_up(whitening, projected, by_state, cauchy_scale, hessian_there, gradient_there, squared, weights)
            loss_there = np.log1p(squared / cauchy_scale**2).sum()
        if taken > 0 and not loss_there <= loss:
            damping *= 10
        else:
            converged = taken > 0 and loss - loss_there <= min_decrease * loss
            pose[:], hessian, gradient = there, hessian_there, gradient_there
            loss, damping = loss_there, damping / 10
            if converged:
                break
        damped = hessian + damping * np.diag(np.diag(hessian))
        step[:] = -gradient
        if not _solve(damped, step):
            return False
        _move(pose, step, there)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(matrix, vector):
    """Replace a vector (N,) by the symmetric, positive definite matrix's (N, N) inverse times it, by Cholesky.

    The matrix is written over. Return whether it is positive definite.
    """
    count = len(vector)
    for i in range(count):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = total / matrix[j, j]
            elif total > 0:
                matrix[i, i] = math.sqrt(total)
            else:
                return False
    for i in range(count):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _move(pose, step, moved):
    """Fill in a pose (4, 4) moved by a step (6,), as common/geometry.py does."""
    x, y, z = step[3], step[4], step[5]
    angle = math.sqrt(x * x + y * y + z * z)
    first, second = 1.0, 0.5
    if angle > _SMALL_ANGLE:
        first, second = math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2
    moved[:] = pose
    for column in range(4):
        a, b, c = pose[0, column], pose[1, column], pose[2, column]
        if column == 3:
            moved[0, 3], moved[1, 3], moved[2, 3] = a + step[0], b + step[1], c + step[2]
            continue
        # The rotation vector times the column, and times that.
        p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
        moved[0, column] = a + first * p + second * (y * r - z * q)
        moved[1, column] = b + first * q + second * (z * p - x * r)
        moved[2, column] = c + first * r + second * (x * q - y * p)
