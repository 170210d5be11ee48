"""Numba kernels of the CPU renderer.

Everything is float32 and written so that LLVM vectorises the loops over a row of pixels. In numba a float32 meets an
int64 or a bare literal as float64: hence the constants below and the casts.
"""

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import njit, prange, types
from numba.extending import intrinsic

from gsfeatloc_ros.render import base

TILE = 16
# Columns of a projected splat. The conic is scaled by -log2(e)/2 and opacity is a log2, so that
# alpha = 2^(LOG_OPACITY + CONIC_XX dx^2 + CONIC_XY dx dy + CONIC_YY dy^2).
X, Y, CONIC_XX, CONIC_XY, CONIC_YY, LOG_OPACITY, REACH_Y, RED, GREEN, BLUE, DEPTH = range(11)
SPLAT_SIZE = 11

_F = np.float32
_ZERO, _HALF, _ONE = _F(0), _F(0.5), _F(1)
_EPS2D, _NEAR = _F(base.EPS2D), _F(base.NEAR_PLANE)
_MIN_ALPHA, _MAX_ALPHA = _F(base.MIN_ALPHA), _F(base.MAX_ALPHA)
_MIN_TRANSMITTANCE, _DEPTH_MIN_ALPHA = _F(base.MIN_TRANSMITTANCE), _F(base.DEPTH_MIN_ALPHA)
_CONIC_SCALE = _F(-0.5 * math.log2(math.e))
_NAN = _F(np.nan)
# 2^f on [0, 1): minimax polynomial of degree 5, relative error 2e-7.
_P0, _P1, _P2 = _F(9.9999994e-1), _F(6.9315308e-1), _F(2.4015361e-1)
_P3, _P4, _P5 = _F(5.5826318e-2), _F(8.9893397e-3), _F(1.8775767e-3)
_EXP2_LOWEST = _F(-126)
# Spherical harmonics' constants, as in render/reference.py.
_SH0, _SH1 = _F(0.28209479177387814), _F(0.4886025119029199)
_SH2 = (_F(1.0925484305920792), _F(0.31539156525252005), _F(0.5462742152960396))
_SH3 = (
    _F(0.5900435899266435),
    _F(2.890611442640554),
    _F(0.4570457994644658),
    _F(0.3731763325901154),
    _F(1.445305721320277),
)
_TWO, _THREE, _FOUR = _F(2), _F(3), _F(4)

# Not "fast": NaN and infinity keep their meaning, and the rounding in exp2 is not optimised away.
_MATH = {"contract", "nsz", "arcp"}


@intrinsic
def _float_of_bits(typingctx, bits):
    """Reinterpret an int32 as a float32."""

    def codegen(context, builder, signature, args):
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), codegen


@intrinsic
def _bits_of_float(typingctx, value):
    """Reinterpret a float32 as a uint32."""

    def codegen(context, builder, signature, args):
        return builder.bitcast(args[0], ir.IntType(32))

    return types.uint32(types.float32), codegen


@njit(inline="always", fastmath=_MATH)
def _exp2(x):
    x = max(x, _EXP2_LOWEST)
    whole = np.floor(x)
    f = x - whole
    power = _float_of_bits(np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)))
    return power * (_P0 + f * (_P1 + f * (_P2 + f * (_P3 + f * (_P4 + f * _P5)))))


@njit(parallel=True, nogil=True, cache=True)
def covariances(scales, rotations):
    """Covariances (N, 6) float32 (xx xy xz yy yz zz) of Gaussians, in the map frame: R diag(scale^2) R^T."""
    out = np.empty((len(scales), 6), dtype=np.float32)
    for i in prange(len(scales)):
        w, x, y, z = rotations[i]
        axes = np.empty((3, 3), dtype=np.float32)
        axes[0, 0], axes[0, 1], axes[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        axes[1, 0], axes[1, 1], axes[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        axes[2, 0], axes[2, 1], axes[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        for column in range(3):
            axes[:, column] *= scales[i, column]
        out[i, 0] = np.sum(axes[0] * axes[0])
        out[i, 1] = np.sum(axes[0] * axes[1])
        out[i, 2] = np.sum(axes[0] * axes[2])
        out[i, 3] = np.sum(axes[1] * axes[1])
        out[i, 4] = np.sum(axes[1] * axes[2])
        out[i, 5] = np.sum(axes[2] * axes[2])
    return out


@njit(inline="always", fastmath=_MATH)
def _color(sh, x, y, z, channel):
    """Colour of one channel of spherical harmonics (C, 3) in the unit direction x, y, z."""
    count = sh.shape[0]
    color = _HALF + _SH0 * sh[0, channel]
    if count > 1:
        color += _SH1 * (z * sh[2, channel] - y * sh[1, channel] - x * sh[3, channel])
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        color += (
            _SH2[0] * (x * y * sh[4, channel] - y * z * sh[5, channel] - x * z * sh[7, channel])
            + _SH2[1] * (_TWO * zz - xx - yy) * sh[6, channel]
            + _SH2[2] * (xx - yy) * sh[8, channel]
        )
        if count > 9:
            color += (
                _SH3[1] * x * y * z * sh[10, channel]
                - _SH3[0] * (y * (_THREE * xx - yy) * sh[9, channel] + x * (xx - _THREE * yy) * sh[15, channel])
                - _SH3[2] * (_FOUR * zz - xx - yy) * (y * sh[11, channel] + x * sh[13, channel])
                + _SH3[3] * z * (_TWO * zz - _THREE * xx - _THREE * yy) * sh[12, channel]
                + _SH3[4] * z * (xx - yy) * sh[14, channel]
            )
    return max(color, _ZERO)


@njit(inline="always", fastmath=_MATH)
def _band_extent(a, b, c, r2, low, high):
    """Range of x of the ellipse a x^2 + 2 b x y + c y^2 <= r2 within low <= y <= high (which it meets)."""
    determinant = a * c - b * b
    widest = math.sqrt(r2 * c / determinant)
    y_of_widest = b * widest / c  # the leftmost point; the rightmost is its mirror image

    def edge(y):
        return math.sqrt(max(b * b * y * y - a * (c * y * y - r2), _ZERO))

    left = -widest
    if not low <= y_of_widest <= high:
        y = low if y_of_widest < low else high
        left = (-b * y - edge(y)) / a
    right = widest
    if not low <= -y_of_widest <= high:
        y = low if -y_of_widest < low else high
        right = (-b * y + edge(y)) / a
    return left, right


@njit(parallel=True, nogil=True, cache=True, fastmath=_MATH)
def project(
    means, covariances, opacities, sh, antialiased, pose, K, width, height, splats, pair_tiles, pair_splats, histogram
):
    """Project Gaussians and list the tiles that each touches.

    Each thread takes a run of Gaussians and writes its own segment of the pair lists and its own row of the histogram,
    in map order. A segment too small is left incomplete.

    Args:
        means (N, 3), covariances (N, 6), opacities (N,), sh (N, C, 3): float32, splat frame.
        antialiased: dim each Gaussian as much as the blur widens it (Yu et al., "Mip-Splatting", 2024, eq. 9).
        pose: (4, 4) float64 T_splat_camera.
        K: (3, 3) float64 intrinsics.
        splats: (N, SPLAT_SIZE) float32, written for the visible Gaussians.
        pair_tiles, pair_splats: (threads, capacity) int32, written.
        histogram: (threads, tiles) int64, written: pairs of each tile.

    Returns:
        (threads,) int64: pairs that each thread has, to be compared with the capacity.
    """
    threads, capacity = pair_tiles.shape
    tiles_x = -(-width // TILE)
    needed = np.zeros(threads, dtype=np.int64)
    camera = pose[:3, 3].copy()
    r = pose[:3, :3].T.astype(np.float32)
    fx, fy, cx, cy = _F(K[0, 0]), _F(K[1, 1]), _F(K[0, 2]), _F(K[1, 2])
    margin_x, margin_y = _F(0.3 * 0.5 * width / K[0, 0]), _F(0.3 * 0.5 * height / K[1, 1])
    limit_left = -_F((K[0, 2] + 0.5) / K[0, 0]) - margin_x
    limit_right = _F((width - K[0, 2] - 0.5) / K[0, 0]) + margin_x
    limit_top = -_F((K[1, 2] + 0.5) / K[1, 1]) - margin_y
    limit_bottom = _F((height - K[1, 2] - 0.5) / K[1, 1]) + margin_y
    last_x, last_y = _F(width - 1), _F(height - 1)

    for thread in prange(threads):
        counts = histogram[thread]
        counts[:] = 0
        pairs = 0
        for i in range(len(means) * thread // threads, len(means) * (thread + 1) // threads):
            # The difference in float64: maps may lie far from their origin.
            ox = _F(means[i, 0] - camera[0])
            oy = _F(means[i, 1] - camera[1])
            oz = _F(means[i, 2] - camera[2])
            z = r[2, 0] * ox + r[2, 1] * oy + r[2, 2] * oz
            if not z > _NEAR:
                continue
            inverse_z = _ONE / z
            u = (r[0, 0] * ox + r[0, 1] * oy + r[0, 2] * oz) * inverse_z
            v = (r[1, 0] * ox + r[1, 1] * oy + r[1, 2] * oz) * inverse_z
            px, py = fx * u + cx, fy * v + cy

            # Rows of the projection's Jacobian, turned into the map frame.
            tu = min(max(u, limit_left), limit_right)
            tv = min(max(v, limit_top), limit_bottom)
            sx, sy = fx * inverse_z, fy * inverse_z
            ax, ay, az = sx * (r[0, 0] - tu * r[2, 0]), sx * (r[0, 1] - tu * r[2, 1]), sx * (r[0, 2] - tu * r[2, 2])
            bx, by, bz = sy * (r[1, 0] - tv * r[2, 0]), sy * (r[1, 1] - tv * r[2, 1]), sy * (r[1, 2] - tv * r[2, 2])
            sxx, sxy, sxz = covariances[i, 0], covariances[i, 1], covariances[i, 2]
            syy, syz, szz = covariances[i, 3], covariances[i, 4], covariances[i, 5]
            vax, vay, vaz = (
                sxx * ax + sxy * ay + sxz * az,
                sxy * ax + syy * ay + syz * az,
                sxz * ax + syz * ay + szz * az,
            )
            cov_xx = ax * vax + ay * vay + az * vaz
            cov_xy = bx * vax + by * vay + bz * vaz
            cov_yy = (
                bx * (sxx * bx + sxy * by + sxz * bz)
                + by * (sxy * bx + syy * by + syz * bz)
                + bz * (sxz * bx + syz * by + szz * bz)
            )
            sharp_determinant = cov_xx * cov_yy - cov_xy * cov_xy
            cov_xx, cov_yy = cov_xx + _EPS2D, cov_yy + _EPS2D
            determinant = cov_xx * cov_yy - cov_xy * cov_xy
            if not (determinant > _ZERO and determinant < _F(np.inf)):
                continue

            opacity = opacities[i]
            if antialiased:
                opacity *= math.sqrt(max(sharp_determinant / determinant, _ZERO))
                if opacity < _MIN_ALPHA:
                    continue

            # The ellipse in which alpha is at least 1/255.
            r2 = _TWO * math.log(opacity / _MIN_ALPHA)
            reach_x, reach_y = math.sqrt(r2 * cov_xx), math.sqrt(r2 * cov_yy)
            if px + reach_x < _ZERO or px - reach_x > last_x or py + reach_y < _ZERO or py - reach_y > last_y:
                continue
            a, b, c = cov_yy / determinant, -cov_xy / determinant, cov_xx / determinant
            splat = splats[i]
            splat[X], splat[Y] = px, py
            splat[CONIC_XX], splat[CONIC_XY], splat[CONIC_YY] = (
                a * _CONIC_SCALE,
                _TWO * b * _CONIC_SCALE,
                c * _CONIC_SCALE,
            )
            splat[LOG_OPACITY] = math.log2(opacity)
            splat[REACH_Y] = reach_y
            splat[DEPTH] = z
            inverse_distance = _ONE / math.sqrt(ox * ox + oy * oy + oz * oz)
            dx, dy, dz = ox * inverse_distance, oy * inverse_distance, oz * inverse_distance
            for channel in range(3):
                splat[RED + channel] = _color(sh[i], dx, dy, dz, channel)

            first_row = int(max(py - reach_y, _ZERO)) // TILE
            last_row = int(min(py + reach_y, last_y)) // TILE
            for row in range(first_row, last_row + 1):
                low, high = max(_F(row * TILE) - py, -reach_y), min(_F(row * TILE + TILE - 1) - py, reach_y)
                if low > high:
                    continue  # between the last row of pixels of one tile and the first of the next
                left, right = _band_extent(a, b, c, r2, low, high)
                if px + right < _ZERO or px + left > last_x:
                    continue
                first = int(max(px + left, _ZERO)) // TILE
                last = int(min(px + right, last_x)) // TILE
                for tile in range(row * tiles_x + first, row * tiles_x + last + 1):
                    if pairs < capacity:
                        pair_tiles[thread, pairs] = tile
                        pair_splats[thread, pairs] = i
                    counts[tile] += 1
                    pairs += 1
        needed[thread] = pairs
    return needed


@njit(nogil=True, cache=True)
def tile_starts(histogram):
    """Where each tile's list starts: (tiles + 1,) int64. `histogram` becomes where each thread's part of it starts."""
    threads, tiles = histogram.shape
    starts = np.empty(tiles + 1, dtype=np.int64)
    total = 0
    for tile in range(tiles):
        starts[tile] = total
        for thread in range(threads):
            count = histogram[thread, tile]
            histogram[thread, tile] = total
            total += count
    starts[tiles] = total
    return starts


@njit(parallel=True, nogil=True, cache=True)
def gather(pair_tiles, pair_splats, needed, positions, by_tile):
    """Write each thread's pairs to their tiles' lists; `positions` (threads, tiles) is where, and is advanced."""
    for thread in prange(len(needed)):
        for pair in range(needed[thread]):
            tile = pair_tiles[thread, pair]
            by_tile[positions[thread, tile]] = pair_splats[thread, pair]
            positions[thread, tile] += 1


@njit(inline="always")
def _sort_by_depth(splats, members, keys, order, spare_keys, spare_order):
    """Fill `order` with `members`, nearest first: a stable radix sort, 8 bits at a time.

    Positive floats sort as their bits do. The passes are four: the result is back in `order`.
    """
    n = len(members)
    counts = np.zeros((4, 256), dtype=np.int64)
    for k in range(n):
        order[k] = members[k]
        key = _bits_of_float(splats[members[k], DEPTH])
        keys[k] = key
        for digit in range(4):
            counts[digit, (key >> np.uint32(8 * digit)) & np.uint32(255)] += 1
    for digit in range(4):
        total = 0
        for value in range(256):
            count = counts[digit, value]
            counts[digit, value] = total
            total += count
        for k in range(n):
            key = keys[k]
            value = (key >> np.uint32(8 * digit)) & np.uint32(255)
            spare_keys[counts[digit, value]] = key
            spare_order[counts[digit, value]] = order[k]
            counts[digit, value] += 1
        keys, spare_keys = spare_keys, keys
        order, spare_order = spare_order, order


@njit(parallel=True, nogil=True, cache=True, fastmath=_MATH)
def blend(splats, by_tile, starts, threads, background, rgb, depth, median_depth, depth_std, alpha):
    """Sort each tile's splats by depth and blend them front to back into the images.

    Args:
        splats: (N, SPLAT_SIZE) float32 from `project`.
        by_tile, starts: splats of each tile, from `gather` and `tile_starts`.
        threads: number of workers; each takes every so many-th tile, so that crowded corners are shared.
        background: (3,) float32.
        rgb (H, W, 3), depth, median_depth, depth_std, alpha (H, W): float32, written.
    """
    height, width = depth.shape
    tiles_x = -(-width // TILE)
    tiles = len(starts) - 1
    longest = 0
    for tile in range(tiles):
        longest = max(longest, starts[tile + 1] - starts[tile])

    for thread in prange(threads):
        keys, spare_keys = np.empty(longest, dtype=np.uint32), np.empty(longest, dtype=np.uint32)
        order, spare_order = np.empty(longest, dtype=np.int32), np.empty(longest, dtype=np.int32)
        transmittance = np.empty(TILE * TILE, dtype=np.float32)
        running = np.empty(TILE * TILE, dtype=np.float32)  # 1 until the ray has ended
        red, green, blue = np.empty_like(running), np.empty_like(running), np.empty_like(running)
        moment1, moment2, median = np.empty_like(running), np.empty_like(running), np.empty_like(running)
        row_running = np.empty(TILE, dtype=np.bool_)
        columns = np.arange(TILE).astype(np.float32)

        for tile in range(thread, tiles, threads):
            members = by_tile[starts[tile] : starts[tile + 1]]
            n = len(members)
            _sort_by_depth(splats, members, keys, order, spare_keys, spare_order)
            x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            rows = min(TILE, height - y0)
            left = _F(x0)
            transmittance[:] = _ONE
            running[:] = _ONE
            red[:] = _ZERO
            green[:] = _ZERO
            blue[:] = _ZERO
            moment1[:] = _ZERO
            moment2[:] = _ZERO
            median[:] = _ZERO
            row_running[:] = True
            rows_running = rows
            # Depths are summed from the nearest one on: the spread is a difference of squares.
            nearest = splats[order[0], DEPTH] if n > 0 else _ZERO

            for k in range(n):
                splat = splats[order[k]]
                dx0 = left - splat[X]
                xx, xy, yy, log_opacity = splat[CONIC_XX], splat[CONIC_XY], splat[CONIC_YY], splat[LOG_OPACITY]
                r, g, b = splat[RED], splat[GREEN], splat[BLUE]
                z = splat[DEPTH] - nearest
                top = max(np.int64(math.ceil(splat[Y] - splat[REACH_Y])) - y0, 0)
                bottom = min(np.int64(math.floor(splat[Y] + splat[REACH_Y])) - y0, rows - 1)
                for row in range(top, bottom + 1):
                    if not row_running[row]:
                        continue
                    dy = _F(y0 + row) - splat[Y]
                    constant, linear = log_opacity + yy * dy * dy, xy * dy
                    first = np.uint64(row * TILE)
                    for column in range(np.uint64(TILE)):
                        at = first + column
                        dx = dx0 + columns[column]
                        a = min(_exp2(constant + dx * (linear + xx * dx)), _MAX_ALPHA)
                        a = a * running[at] if a >= _MIN_ALPHA else _ZERO
                        t = transmittance[at]
                        after = t - t * a
                        ends = after <= _MIN_TRANSMITTANCE
                        weight = _ZERO if ends else t * a
                        running[at] = _ZERO if ends else running[at]
                        transmittance[at] = t - weight
                        median[at] = z if t > _HALF and weight > _ZERO else median[at]
                        red[at] += weight * r
                        green[at] += weight * g
                        blue[at] += weight * b
                        moment1[at] += weight * z
                        moment2[at] += weight * z * z
                if k % 16 == 15:
                    rows_running = 0
                    for row in range(rows):
                        any_running = _ZERO
                        for column in range(TILE):
                            any_running += running[row * TILE + column]
                        row_running[row] = any_running > _ZERO
                        rows_running += any_running > _ZERO
                    if rows_running == 0:
                        break

            for row in range(rows):
                for column in range(min(TILE, width - x0)):
                    at, y, x = row * TILE + column, y0 + row, x0 + column
                    t = transmittance[at]
                    covered = _ONE - t
                    alpha[y, x] = covered
                    rgb[y, x, 0] = min(red[at] + t * background[0], _ONE)
                    rgb[y, x, 1] = min(green[at] + t * background[1], _ONE)
                    rgb[y, x, 2] = min(blue[at] + t * background[2], _ONE)
                    if covered >= _DEPTH_MIN_ALPHA:
                        mean = moment1[at] / covered
                        depth[y, x] = nearest + mean
                        median_depth[y, x] = nearest + median[at]
                        depth_std[y, x] = math.sqrt(max(moment2[at] / covered - mean * mean, _ZERO))
                    else:
                        depth[y, x] = _NAN
                        median_depth[y, x] = _NAN
                        depth_std[y, x] = _NAN
