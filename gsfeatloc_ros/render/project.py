"""Kernel 1 of a frame: project the Gaussians, colour them, and list the tiles that each touches."""

# Kernels take as many parameters as they need: common/kernels.py says why.

from __future__ import annotations

import math

import numpy as np

from gsfeatloc_ros.common.kernels import njit, prange
from gsfeatloc_ros.common.lanes import (
    LANES,
    bits_of_float,
    broadcast,
    floor,
    load,
    load_halves,
    log2,
    mask_bits,
    maximum,
    minimum,
    offsets,
    sqrt,
    store_columns,
    whole,
)
from gsfeatloc_ros.render import base, prepare
from gsfeatloc_ros.render.prepare import CHUNK

TILE = 16
# Fields of a projected splat: alpha = 2^(LOG_OPACITY + CONIC_X (dx - SLANT dy)^2 + CONIC_Y dy^2). Rounding or not, that
# falls away from the centre; the usual sum of dx^2, dx dy and dy^2 may grow along a long needle. The box holds the
# pixels with an alpha of MIN_ALPHA, and is whole numbers. The last two are int32: the first tile that the box touches,
# and how many further columns of tiles, plus _ROW for each further row.
(X, Y, SLANT, CONIC_X, CONIC_Y, LOG_OPACITY, RED, GREEN, BLUE, DEPTH, LEFT, RIGHT, TOP, BOTTOM) = range(14)
_FIRST_TILE, _FURTHER_TILES = 14, 15
_ROW_BITS = 12
_ROW = 1 << _ROW_BITS
# One line of the CPU's cache.
SPLAT_SIZE = 16

_F = np.float32
# With an unsigned index numba does not look for negative ones.
_U = np.uint64
_ZERO, _ONE, _INFINITY = _F(0), _F(1), _F(np.inf)
_EPS2D, _NEAR = _F(base.EPS2D), _F(base.NEAR_PLANE)
_PER_TILE = _F(1.0 / TILE)
_LOG_MIN_ALPHA = _F(math.log2(base.MIN_ALPHA))
# From -0.5 d^T conic d, and from 2 ln(255 opacity), to base 2.
_CONIC_SCALE = _F(-0.5 * math.log2(math.e))
_RADIUS2_SCALE = _F(2.0 * math.log(2.0))
# Spherical harmonics' constants, as in maps/harmonics.py.
_SH0, _SH1 = _F(0.28209479177387814), _F(0.4886025119029199)
_SH2A, _SH2B, _SH2C = (_F(1.0925484305920792), _F(0.31539156525252005), _F(0.5462742152960396))
_SH3A, _SH3B, _SH3C = (_F(0.5900435899266435), _F(2.890611442640554), _F(0.4570457994644658))
_SH3D, _SH3E = _F(0.3731763325901154), _F(1.445305721320277)


@njit(parallel=True, nogil=True, cache=True)
def project(chunks, gaussians, sh, harmonics, antialiased, view, splats, pair_tiles, pair_keys, histogram):
    """Project the Gaussians of `chunks` and list the tiles that each touches.

    Each thread takes a run of chunks and writes its own segment of the pair lists and its own row of the histogram, in
    map order. A segment too small is left incomplete.

    Args:
        chunks: (n,) int64, where they are in `gaussians` and `sh`, from `Resident.slots`.
        gaussians: Resident.gaussians, flat.
        sh: Resident.sh, flat, as int16.
        harmonics: (stored, used) harmonics per channel.
        antialiased: dim each Gaussian as much as the blur widens it (Yu et al., "Mip-Splatting", 2024, eq. 9).
        view: the camera.
        splats: flat float32, n CHUNK records of SPLAT_SIZE, written for the visible Gaussians.
        pair_tiles: (threads, capacity) int32, written.
        pair_keys: (threads, capacity) uint64, written: depth's bits, then the splat's index. Positive floats sort as
            their bits do.
        histogram: (threads, tiles) int64, written: pairs of each tile.

    Returns:
        (threads,) int64: pairs that each thread has, to be compared with the capacity.
    """
    threads = len(pair_tiles)
    tiles_x = -(-view.width // TILE)
    needed = np.zeros(threads, dtype=np.int64)
    for thread in prange(threads):
        tiles, keys, counts = pair_tiles[thread], pair_keys[thread], histogram[thread]
        first, last = len(chunks) * thread // threads, len(chunks) * (thread + 1) // threads
        splat, pairs = first * CHUNK, 0
        for place in range(first, last):
            end = _project_chunk(chunks[place], gaussians, sh, harmonics, antialiased, view, splats, splat)
            pairs = _list_tiles(splats, splat, end, tiles_x, tiles, keys, pairs)
            splat = end
        counts[:] = 0
        for pair in range(min(pairs, len(tiles))):
            counts[_U(tiles[_U(pair)])] += 1
        needed[thread] = pairs
    return needed


@njit
def _project_chunk(chunk, gaussians, sh, harmonics, antialiased, view, splats, splat):
    """Write the visible Gaussians of a chunk to `splats` from the record `splat` on; return the record after them."""
    at = splat * SPLAT_SIZE
    for group in range(0, CHUNK, LANES):
        at = _project_group(chunk, group, gaussians, sh, harmonics, antialiased, view, splats, at)
    return at // SPLAT_SIZE


@njit
def _project_group(chunk, group, gaussians, sh, harmonics, antialiased, view, splats, out):
    """Write the visible ones among LANES Gaussians of a chunk to `splats` from `out` on; return where they end."""
    at = chunk * prepare.ROWS * CHUNK + group
    r = view.rotation
    points = (
        load(gaussians, at + prepare.MEAN_X * CHUNK),
        load(gaussians, at + prepare.MEAN_Y * CHUNK),
        load(gaussians, at + prepare.MEAN_Z * CHUNK),
    )
    # The depth exact to its last bit: splats are drawn in its order, and neighbours are closer than roundings.
    o, f = view.origin, view.forward
    ox, oy, oz, z = offsets(points, (o[0], o[1], o[2]), (f[0], f[1], f[2]))
    inverse_z = _ONE / z
    u = (ox * r[0, 0] + oy * r[0, 1] + oz * r[0, 2]) * inverse_z
    v = (ox * r[1, 0] + oy * r[1, 1] + oz * r[1, 2]) * inverse_z
    px, py = u * view.fx + view.cx, v * view.fy + view.cy

    # Rows of the projection's Jacobian, turned into the splat frame (EWA, eq. 29-31).
    u, v = (minimum(maximum(u, view.left), view.right), minimum(maximum(v, view.top), view.bottom))
    sx, sy = view.fx * inverse_z, view.fy * inverse_z
    ax, ay, az = (sx * (r[0, 0] - u * r[2, 0]), sx * (r[0, 1] - u * r[2, 1]), sx * (r[0, 2] - u * r[2, 2]))
    bx, by, bz = (sy * (r[1, 0] - v * r[2, 0]), sy * (r[1, 1] - v * r[2, 1]), sy * (r[1, 2] - v * r[2, 2]))
    sxx, sxy = (load(gaussians, at + prepare.COV_XX * CHUNK), load(gaussians, at + prepare.COV_XY * CHUNK))
    sxz, syy = (load(gaussians, at + prepare.COV_XZ * CHUNK), load(gaussians, at + prepare.COV_YY * CHUNK))
    syz, szz = (load(gaussians, at + prepare.COV_YZ * CHUNK), load(gaussians, at + prepare.COV_ZZ * CHUNK))
    cax, cay, caz = (sxx * ax + sxy * ay + sxz * az, sxy * ax + syy * ay + syz * az, sxz * ax + syz * ay + szz * az)
    cbx, cby, cbz = (sxx * bx + sxy * by + sxz * bz, sxy * bx + syy * by + syz * bz, sxz * bx + syz * by + szz * bz)
    cov_xx, cov_xy, cov_yy = (
        ax * cax + ay * cay + az * caz,
        bx * cax + by * cay + bz * caz,
        bx * cbx + by * cby + bz * cbz,
    )
    # That of a long needle would drown in rounding, were it taken after the blur.
    sharp_determinant = maximum(cov_xx * cov_yy - cov_xy * cov_xy, _ZERO)
    determinant = sharp_determinant + _EPS2D * (cov_xx + cov_yy + _EPS2D)
    cov_xx, cov_yy = cov_xx + _EPS2D, cov_yy + _EPS2D

    log_opacity = load(gaussians, at + prepare.LOG2_OPACITY * CHUNK)
    if antialiased:
        log_opacity = log_opacity + _F(0.5) * log2(sharp_determinant / determinant)
    # The ellipse in which alpha is at least MIN_ALPHA, and the pixels in its box.
    r2 = (log_opacity - _LOG_MIN_ALPHA) * _RADIUS2_SCALE
    reach_x, reach_y = sqrt(r2 * cov_xx), sqrt(r2 * cov_yy)
    left, right = (_ceil(maximum(px - reach_x, _ZERO)), floor(minimum(px + reach_x, _F(view.width - 1))))
    top, bottom = (_ceil(maximum(py - reach_y, _ZERO)), floor(minimum(py + reach_y, _F(view.height - 1))))
    # Comparisons with NaN are false.
    finite = (determinant > _ZERO) & (determinant < _INFINITY) & (px < _INFINITY) & (py < _INFINITY)
    visible = finite & (z > _NEAR) & (r2 >= _ZERO) & (left <= right) & (top <= bottom)
    if mask_bits(visible) == 0:
        return out

    inverse_distance = _ONE / sqrt(ox * ox + oy * oy + oz * oz)
    red, green, blue = _colors(
        sh,
        chunk * 3 * harmonics[0] * CHUNK + group,
        harmonics[1],
        ox * inverse_distance,
        oy * inverse_distance,
        oz * inverse_distance,
    )
    tiles_x = _F(-(-view.width // TILE))
    first_column, first_row = floor(left * _PER_TILE), floor(top * _PER_TILE)
    columns, rows = floor(right * _PER_TILE) - first_column, floor(bottom * _PER_TILE) - first_row
    return store_columns(
        splats,
        out,
        visible,
        (
            px,
            py,
            cov_xy / cov_yy,
            _CONIC_SCALE * cov_yy / determinant,
            _CONIC_SCALE / cov_yy,
            log_opacity,
            red,
            green,
            blue,
            z,
            left,
            right,
            top,
            bottom,
            whole(first_row * tiles_x + first_column),
            whole(rows * _F(_ROW) + columns),
        ),
    )


@njit
def _ceil(x):
    return _ZERO - floor(_ZERO - x)


@njit
def _colors(sh, at, harmonics, x, y, z):
    """Return red, green and blue of spherical harmonics in the unit directions x, y, z."""
    half = broadcast(_F(0.5))
    color = _add_harmonic(sh, at, 0, broadcast(_SH0), (half, half, half))
    if harmonics > 1:
        color = _add_harmonic(sh, at, 1, -_SH1 * y, color)
        color = _add_harmonic(sh, at, 2, _SH1 * z, color)
        color = _add_harmonic(sh, at, 3, -_SH1 * x, color)
    if harmonics > 4:
        xx, yy, zz = x * x, y * y, z * z
        xy, yz, xz = x * y, y * z, x * z
        color = _add_harmonic(sh, at, 4, _SH2A * xy, color)
        color = _add_harmonic(sh, at, 5, -_SH2A * yz, color)
        color = _add_harmonic(sh, at, 6, _SH2B * (_F(2) * zz - xx - yy), color)
        color = _add_harmonic(sh, at, 7, -_SH2A * xz, color)
        color = _add_harmonic(sh, at, 8, _SH2C * (xx - yy), color)
        if harmonics > 9:
            color = _add_harmonic(sh, at, 9, -_SH3A * y * (_F(3) * xx - yy), color)
            color = _add_harmonic(sh, at, 10, _SH3B * xy * z, color)
            color = _add_harmonic(sh, at, 11, -_SH3C * y * (_F(4) * zz - xx - yy), color)
            color = _add_harmonic(sh, at, 12, _SH3D * z * (_F(2) * zz - _F(3) * (xx + yy)), color)
            color = _add_harmonic(sh, at, 13, -_SH3C * x * (_F(4) * zz - xx - yy), color)
            color = _add_harmonic(sh, at, 14, _SH3E * z * (xx - yy), color)
            color = _add_harmonic(sh, at, 15, -_SH3A * x * (xx - _F(3) * yy), color)
    return maximum(color[0], _ZERO), maximum(color[1], _ZERO), maximum(color[2], _ZERO)


@njit
def _add_harmonic(sh, at, k, basis, color):
    return (
        color[0] + basis * load_halves(sh, at + (3 * k) * CHUNK),
        color[1] + basis * load_halves(sh, at + (3 * k + 1) * CHUNK),
        color[2] + basis * load_halves(sh, at + (3 * k + 2) * CHUNK),
    )


@njit
def _list_tiles(splats, first, last, tiles_x, tiles, keys, pairs):
    """Append the tiles that splats touch to a thread's list, which holds `pairs`; return how many it holds then."""
    numbers = splats.view(np.int32)
    for splat in range(first, last):
        at = _U(splat * SPLAT_SIZE)
        key = _U(bits_of_float(splats[at + _U(DEPTH)])) << _U(32) | _U(splat)
        tile, further = np.int64(numbers[at + _U(_FIRST_TILE)]), np.int64(numbers[at + _U(_FURTHER_TILES)])
        columns, rows = further & (_ROW - 1), further >> _ROW_BITS
        if columns > 1 or rows > 1 or pairs + 4 > len(tiles):
            pairs = _list_many_tiles(splats, splat * SPLAT_SIZE, key, tile, columns, rows, tiles_x, tiles, keys, pairs)
            continue
        # One tile, two, or four, without a branch on which: that cannot be predicted. What is too much is overwritten.
        for k in range(4):
            keys[_U(pairs + k)] = key
        below = tile + rows * tiles_x
        tiles[_U(pairs)], tiles[_U(pairs + 1)] = tile, tile + columns
        pairs += 1 + columns
        tiles[_U(pairs)], tiles[_U(pairs + 1)] = below, below + columns
        pairs += rows * (1 + columns)
    return pairs


@njit
def _list_many_tiles(splats, at, key, tile, columns, rows, tiles_x, tiles, keys, pairs):
    """Append a splat's tiles, however many, while there is room; return how many pairs there are or would be then."""
    first_row, first_column = tile // tiles_x, tile % tiles_x
    for row in range(first_row, first_row + rows + 1):
        left, right = first_column, first_column + columns
        # The ellipse leaves out the corners of its box; in a smaller one that saves less than it takes to find out.
        if columns > 1 and rows > 1:
            low, high = max(_F(row * TILE), splats[at + TOP]), min(_F(row * TILE + TILE - 1), splats[at + BOTTOM])
            band_left, band_right = _ellipse_in_rows(splats, at, low, high)
            # In this order they are whole numbers even where the ellipse is NaN.
            left = np.int64(max(splats[at + LEFT], band_left)) // TILE
            right = np.int64(min(splats[at + RIGHT], band_right)) // TILE
        for column in range(left, right + 1):
            if pairs < len(tiles):
                tiles[pairs], keys[pairs] = row * tiles_x + column, key
            pairs += 1
    return pairs


@njit(error_model="numpy")
def _ellipse_in_rows(splats, at, first, last):
    """Return the leftmost and rightmost x of a splat's ellipse within the rows `first` to `last`, which it meets."""
    # a (dx - slant dy)^2 + b dy^2 <= level
    slant, a, b = splats[at + SLANT], -splats[at + CONIC_X], -splats[at + CONIC_Y]
    level = splats[at + LOG_OPACITY] - _LOG_MIN_ALPHA
    low, high = first - splats[at + Y], last - splats[at + Y]
    y_of_rightmost = slant / b * math.sqrt(level / (_ONE / a + slant * slant / b))  # the leftmost is its mirror image

    left_y, right_y = min(max(low, -y_of_rightmost), high), min(max(low, y_of_rightmost), high)
    left = slant * left_y - math.sqrt(max(level - b * left_y * left_y, _ZERO) / a)
    right = slant * right_y + math.sqrt(max(level - b * right_y * right_y, _ZERO) / a)
    return splats[at + X] + left, splats[at + X] + right
