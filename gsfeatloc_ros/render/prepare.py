"""What is made of a map once, when it is loaded: Gaussians in the order and form that the CPU renderer needs."""

# Kernels take as many parameters as they need: common/kernels.py says why.

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gsfeatloc_ros.common.kernels import njit, prange
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.render.base import MIN_ALPHA
from gsfeatloc_ros.render.chunks import (
    CHUNK,
    COV_XX,
    COV_XY,
    COV_XZ,
    COV_YY,
    COV_YZ,
    COV_ZZ,
    KERNEL_LOCK,
    LARGE_MAP,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    MEAN_Z,
    ROWS,
    PreparedMap,
    level_starts,
)
from gsfeatloc_ros.render.levels import merge_levels
from gsfeatloc_ros.render.store import grow_box, half_bits

_OCTAVE_BITS = 3


def prepare(gaussian_map: GaussianMap, large: int = LARGE_MAP) -> PreparedMap:
    """Prepare a map for a renderer. The result shares no memory with the map.

    Args:
        gaussian_map: the map.
        large: with more Gaussians than this that can be seen it gets coarser levels.
    """
    means, scales, rotations, opacities, sh = (
        np.ascontiguousarray(values, dtype=np.float32)
        for values in (
            gaussian_map.means,
            gaussian_map.scales,
            gaussian_map.rotations,
            gaussian_map.opacities,
            gaussian_map.sh,
        )
    )
    seen = opacities >= MIN_ALPHA
    count = int(np.count_nonzero(seen))
    leaves = -(-count // CHUNK)
    chunks = int(level_starts(leaves, count > large)[-1])
    gaussians = np.empty((chunks, ROWS, CHUNK), dtype=np.float32)
    prepared = PreparedMap(
        gaussians=gaussians,
        sh=np.empty((chunks, 3 * sh.shape[1], CHUNK), dtype=np.float16),
        low=np.empty((chunks, 3), dtype=np.float32),
        high=np.empty((chunks, 3), dtype=np.float32),
        sizes=np.zeros(chunks, dtype=np.float32),
        leaves=leaves,
        antialiased=gaussian_map.antialiased,
        S_map_splat=gaussian_map.S_map_splat,
        reading=gaussian_map.reading,
    )
    # Sorted in the memory that the Gaussians then take: there is least to spare at this time.
    keys = gaussians.reshape(-1).view(np.uint64)[:count]
    _list_seen(seen, keys)
    sample = keys[:: sample_step(count)]
    with KERNEL_LOCK:
        order = drawing_order(means, scales, Grid.of(means[sample], scales[sample], len(seen)), keys)
        fill_chunks(
            order,
            means,
            scales,
            rotations,
            opacities,
            sh.reshape(len(sh), 3 * sh.shape[1]),
            prepared.gaussians[:leaves],
            prepared.sh[:leaves].view(np.int16),
            prepared.low,
            prepared.high,
        )
    merge_levels(prepared)
    return prepared


class Grid(NamedTuple):
    """By what Gaussians are sorted: their size, then the cell of a grid in which they lie.

    Attributes:
        low: (3,) corner of the grid, splat frame.
        cell: how large a cell is.
        size: the usual size of a Gaussian.
        morton_bits: the grid has 2^morton_bits cells along each axis.
        index_bits: of the numbers of the Gaussians.
    """

    low: np.ndarray
    cell: float
    size: float
    morton_bits: int
    index_bits: int

    @staticmethod
    def of(means: np.ndarray, scales: np.ndarray, count: int) -> Grid:
        """Return one for `count` Gaussians, by the means and scales (m, 3) of some of those that can be seen."""
        index_bits = count.bit_length()
        morton_bits = (64 - _OCTAVE_BITS - index_bits) // 3
        if not len(means):
            return Grid(np.zeros(3), 1.0, 1.0, morton_bits, index_bits)
        # Floaters far from everything share the cells at the border, lest all else shares one.
        low, high = np.percentile(means, [1, 99], axis=0)
        low, high = low - (high - low), high + (high - low)
        cell = max(np.max(high - low), np.finfo(np.float32).tiny) / 2**morton_bits
        return Grid(low, cell, np.median(scales.max(axis=1)), morton_bits, index_bits)


def sample_step(count: int) -> int:
    """Return that every so many of `count` Gaussians are looked at for a grid."""
    return 1 + count // 10_000


def drawing_order(means: np.ndarray, scales: np.ndarray, grid: Grid, keys: np.ndarray) -> np.ndarray:
    """Return some numbers of Gaussians (n,) int32 in another order: neighbours in space together, small ones first.

    Args:
        means, scales: (N, 3) of all.
        grid: that they are sorted by.
        keys: (n,) uint64, the numbers, to work in.
    """
    # A key ends with the index: to sort numbers takes a fraction of the time and of the memory of sorting indices.
    drawing_keys(means, scales, grid, keys).sort()
    keys &= np.uint64((1 << grid.index_bits) - 1)
    return keys.astype(np.int32)


def drawing_keys(means: np.ndarray, scales: np.ndarray, grid: Grid, keys: np.ndarray) -> np.ndarray:
    """Turn numbers of Gaussians into keys, in place: their place in the order, and in grid.index_bits the number."""
    _make_keys(keys, means, scales, grid.low, grid.cell, grid.size, grid.morton_bits, grid.index_bits)
    return keys


@njit(nogil=True, cache=True)
def _list_seen(seen, indices):
    count = 0
    for index in range(len(seen)):
        if seen[index]:
            indices[count] = index
            count += 1


@njit(parallel=True, nogil=True, cache=True)
def _make_keys(keys, means, scales, low, cell, size, morton_bits, index_bits):
    """Turn the indices in `keys` into keys: from the highest bits down octave, Morton code, index.

    The octave is that of the Gaussian's size, from `size` up: those of like size share chunks, for one large one would
    make a box large for all. The Morton code is on a grid of 2^morton_bits cubes of `cell` along each axis from `low`.
    """
    for i in prange(len(keys)):
        index = np.int64(keys[i])
        octave = math.log2(max(scales[index, 0], scales[index, 1], scales[index, 2]) / size)
        code = np.uint64(min(max(octave, 0.0), 2.0**_OCTAVE_BITS - 1)) << np.uint64(3 * morton_bits)
        for axis in range(3):
            place = (means[index, axis] - low[axis]) / cell
            bits = np.uint64(min(max(place, 0.0), 2.0**morton_bits - 1))
            # Two zeros between each bit and the next.
            bits = (bits | bits << np.uint64(32)) & np.uint64(0x1F00000000FFFF)
            bits = (bits | bits << np.uint64(16)) & np.uint64(0x1F0000FF0000FF)
            bits = (bits | bits << np.uint64(8)) & np.uint64(0x100F00F00F00F00F)
            bits = (bits | bits << np.uint64(4)) & np.uint64(0x10C30C30C30C30C3)
            bits = (bits | bits << np.uint64(2)) & np.uint64(0x1249249249249249)
            code |= bits << np.uint64(axis)
        keys[i] |= code << np.uint64(index_bits)


@njit(parallel=True, nogil=True, cache=True)
def fill_chunks(order, means, scales, rotations, opacities, sh, gaussians, sh_bits, low, high):
    for chunk in prange(len(gaussians)):
        low[chunk], high[chunk] = np.inf, -np.inf
        rows = gaussians[chunk]
        for slot in range(CHUNK):
            place = chunk * CHUNK + slot
            if place >= len(order):
                rows[:, slot] = 0
                rows[LOG2_OPACITY, slot] = -np.inf
                sh_bits[chunk, :, slot] = 0
                continue
            i = order[place]
            w, x, y, z = rotations[i]
            a, b, c = scales[i]
            # The axes R diag(scale); the covariance is their product with their transpose.
            xa, xb, xc = (a * (1 - 2 * (y * y + z * z)), b * 2 * (x * y - w * z), c * 2 * (x * z + w * y))
            ya, yb, yc = (a * 2 * (x * y + w * z), b * (1 - 2 * (x * x + z * z)), c * 2 * (y * z - w * x))
            za, zb, zc = (a * 2 * (x * z - w * y), b * 2 * (y * z + w * x), c * (1 - 2 * (x * x + y * y)))
            rows[MEAN_X, slot], rows[MEAN_Y, slot], rows[MEAN_Z, slot] = means[i]
            rows[COV_XX, slot] = xa * xa + xb * xb + xc * xc
            rows[COV_XY, slot] = xa * ya + xb * yb + xc * yc
            rows[COV_XZ, slot] = xa * za + xb * zb + xc * zc
            rows[COV_YY, slot] = ya * ya + yb * yb + yc * yc
            rows[COV_YZ, slot] = ya * za + yb * zb + yc * zc
            rows[COV_ZZ, slot] = za * za + zb * zb + zc * zc
            rows[LOG2_OPACITY, slot] = math.log2(opacities[i])
            for k in range(sh.shape[1]):
                sh_bits[chunk, k, slot] = half_bits(sh[i, k])
            # How many standard deviations from the centre alpha falls to MIN_ALPHA.
            deviations = math.sqrt(max(2 * math.log(opacities[i] / MIN_ALPHA), 0.0))
            grow_box(rows, slot, deviations, low[chunk], high[chunk])
