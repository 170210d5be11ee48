"""Sums over matches, compiled. They take as many parameters as they need: common/kernels.py says why."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.kernels import njit


@njit(cache=True, nogil=True, error_model="numpy")
def linearize_points(K, pose, deviation, points, when, projected, by_state, by_point):
    """Fill in the arrays of a Linear (pose/linear.py); return whether all points are ahead."""
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
def add_up(whitening, residuals, jacobian, cauchy_scale, hessian, gradient, squared, weights):
    """Fill in the arrays of NormalEquations (pose/linear.py), whose Hessian and gradient are zero."""
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


@njit(cache=True, nogil=True)
def mean_products(pixels, residuals, agrees, near_distance, far_distance):
    """Return half the mean product of residuals (M, 2) nearer to each other, and of those farther apart, 0 if negative.

    Those that do not agree (M,) count among the nearer ones alone.
    """
    near = apart = 0.0
    near_pairs = apart_pairs = 0
    for a in range(len(pixels)):
        for b in range(a):
            distance = (pixels[a, 0] - pixels[b, 0]) ** 2 + (pixels[a, 1] - pixels[b, 1]) ** 2
            if distance >= far_distance**2:
                continue
            product = 0.5 * (residuals[a, 0] * residuals[b, 0] + residuals[a, 1] * residuals[b, 1])
            if distance < near_distance**2:
                near += product
                near_pairs += 1
            elif agrees[a] and agrees[b]:
                apart += product
                apart_pairs += 1
    return max(near / max(near_pairs, 1), 0.0), max(apart / max(apart_pairs, 1), 0.0)
