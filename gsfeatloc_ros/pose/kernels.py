"""Loops over matches, compiled. They take as many parameters as they need: common/kernels.py says why."""

from __future__ import annotations

import math

import numpy as np

from gsfeatloc_ros.common.kernels import njit

_GAUSSIAN_MEDIAN = 2 * math.log(2)
_TINY = np.finfo(np.float64).tiny


@njit(cache=True, nogil=True)
def bilinear_neighbours(pixels, width, height):
    """Return the places (M, 4), in a flat picture, and the weights of the neighbours of pixels (M, 2) float64.

    The weights of pixels that are not in the picture are NaN.
    """
    places, weights = np.zeros((len(pixels), 4), np.int64), np.full((len(pixels), 4), np.nan)
    for i in range(len(pixels)):
        x, y = pixels[i, 0], pixels[i, 1]
        if not (0 <= x <= width - 1 and 0 <= y <= height - 1):
            continue
        column, row = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
        right, down = x - column, y - row
        for neighbour in range(4):
            below, beside = neighbour // 2, neighbour % 2
            # Pictures of one row or column have no other.
            places[i, neighbour] = (row + min(below, height - 1)) * width + column + min(beside, width - 1)
            weights[i, neighbour] = (right if beside else 1 - right) * (down if below else 1 - down)
    return places, weights


@njit(cache=True, nogil=True)
def surface_depths(median_depth, depth_std, alpha, places, weights, min_alpha, max_step, max_spread):
    """Return the depth (M,) float64 and its spread (M,) by neighbours, NaN where they are not of one surface.

    Args:
        median_depth, depth_std, alpha: of a render, flat; NaN where there is none.
        places, weights: (M, 4) of the neighbours; weights are NaN where there are none.
        min_alpha, max_step, max_spread: LiftOptions (pose/lift.py).
    """
    depths, spreads = np.full(len(places), np.nan), np.full(len(places), np.nan)
    for i in range(len(places)):
        depth = spread = 0.0
        least = covered = np.inf
        most = -np.inf
        for neighbour in range(4):
            place, weight = places[i, neighbour], weights[i, neighbour]
            depth += weight * median_depth[place]
            spread += weight * depth_std[place]
            least, most = min(least, median_depth[place]), max(most, median_depth[place])
            covered = min(covered, alpha[place])
        # Comparisons with NaN are false.
        if covered >= min_alpha and most - least <= max_step * depth and spread <= max_spread * depth:
            depths[i], spreads[i] = depth, spread
    return depths, spreads


@njit(cache=True, nogil=True, error_model="numpy")
def whitening_matrices(residuals, by_point, sigmas, min_sigma, rounds):
    """Return matrices W (M, 2, 2) with W^T W the inverse covariances of residuals (M, 2) of matches.

    A covariance is the smear of the point's uncertainty, `by_point` (M, 2, 3) times `sigmas` (M, 3), in pixels, and the
    keypoints' noise, which is chosen in `rounds` so that the median whitened residual is as long as a Gaussian's, but
    no less than `min_sigma` squared. W shortens what lies along the smear.
    """
    count = len(residuals)
    smears = np.empty((count, 2))
    lengths, squares, along = np.empty(count), np.empty(count), np.empty(count)
    for match in range(count):
        for axis in range(2):
            smears[match, axis] = (
                by_point[match, axis, 0] * sigmas[match, 0]
                + by_point[match, axis, 1] * sigmas[match, 1]
                + by_point[match, axis, 2] * sigmas[match, 2]
            )
        lengths[match] = residuals[match, 0] ** 2 + residuals[match, 1] ** 2
        squares[match] = smears[match, 0] ** 2 + smears[match, 1] ** 2
        along[match] = (smears[match, 0] * residuals[match, 0] + smears[match, 1] * residuals[match, 1]) ** 2
    # Of a 2D Gaussian, the median of the squared length is 2 ln 2 variances.
    noise = max(np.median(lengths) / _GAUSSIAN_MEDIAN, min_sigma**2)
    for _ in range(rounds):
        # The squared whitened length times the noise, by the inverse of noise * I + smear smear^T.
        noise = max(np.median(lengths - along / (noise + squares)) / _GAUSSIAN_MEDIAN, min_sigma**2)
    matrices = np.empty((count, 2, 2))
    for match in range(count):
        # The inverse square root of noise * I + smear smear^T.
        shortened = (1.0 - math.sqrt(noise / (noise + squares[match]))) / max(squares[match], _TINY)
        for i in range(2):
            for j in range(2):
                product = smears[match, i] * smears[match, j]
                matrices[match, i, j] = ((i == j) - shortened * product) / math.sqrt(noise)
    return matrices


@njit(cache=True, nogil=True, error_model="numpy")
def linearize_points(K, pose, deviation, points, when, projected, by_state, by_point):
    """Fill in the arrays of a Linear (pose/linear.py); return whether all points are ahead."""
    # Element by element: of a row that has a name numba counts the users, at each match.
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
            # By the point in the camera's frame, by the quotient rule; how k1 changes with it is left out: it is small.
            u, v, w = longer * K[axis, 0] / c, longer * K[axis, 1] / c, -longer * along / c
            p = u * pose[0, 0] + v * pose[0, 1] + w * pose[0, 2]
            q = u * pose[1, 0] + v * pose[1, 1] + w * pose[1, 2]
            r = u * pose[2, 0] + v * pose[2, 1] + w * pose[2, 2]
            by_point[match, axis, 0], by_point[match, axis, 1], by_point[match, axis, 2] = p, q, r
            by_state[match, axis, 0], by_state[match, axis, 1], by_state[match, axis, 2] = -p, -q, -r
            by_state[match, axis, 3], by_state[match, axis, 4] = q * z - r * y, r * x - p * z
            by_state[match, axis, 5] = p * y - q * x
            by_state[match, axis, 6] = along * bent
            by_state[match, axis, 7] = longer * along * radius2
            by_state[match, axis, 8] = when[match] * (v * c - w * b)
            by_state[match, axis, 9] = when[match] * (w * a - u * c)
            by_state[match, axis, 10] = when[match] * (u * b - v * a)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def add_up(whitening, residuals, jacobian, cauchy_scale, hessian, gradient, squared, weights):
    """Fill in the arrays of NormalEquations (pose/linear.py), whose Hessian and gradient are zero."""
    count = len(gradient)
    white = np.empty((2, count))
    for match in range(len(residuals)):
        w00, w01, w10, w11 = (
            whitening[match, 0, 0],
            whitening[match, 0, 1],
            whitening[match, 1, 0],
            whitening[match, 1, 1],
        )
        first = w00 * residuals[match, 0] + w01 * residuals[match, 1]
        second = w10 * residuals[match, 0] + w11 * residuals[match, 1]
        squared[match] = first * first + second * second
        weight = 1.0 / (1.0 + squared[match] / cauchy_scale**2)
        weights[match] = weight
        for i in range(count):
            white[0, i] = w00 * jacobian[match, 0, i] + w01 * jacobian[match, 1, i]
            white[1, i] = w10 * jacobian[match, 0, i] + w11 * jacobian[match, 1, i]
        for i in range(count):
            first_weighted, second_weighted = weight * white[0, i], weight * white[1, i]
            gradient[i] += first_weighted * first + second_weighted * second
            for j in range(i + 1):
                hessian[i, j] += first_weighted * white[0, j] + second_weighted * white[1, j]
    for i in range(count):
        for j in range(i):
            hessian[j, i] = hessian[i, j]


@njit(cache=True, nogil=True)
def mean_product(pixels, residuals, least_distance, distance):
    """Return half the mean product of residuals (M, 2) at pixels (M, 2) so far from each other; 0 if negative."""
    total, pairs = 0.0, 0
    for a in range(len(pixels)):
        for b in range(a):
            squared = (pixels[a, 0] - pixels[b, 0]) ** 2 + (pixels[a, 1] - pixels[b, 1]) ** 2
            if least_distance**2 <= squared < distance**2:
                total += 0.5 * (residuals[a, 0] * residuals[b, 0] + residuals[a, 1] * residuals[b, 1])
                pairs += 1
    return max(total / max(pairs, 1), 0.0)
