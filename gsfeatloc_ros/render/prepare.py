"""What is made of a map once, when it is loaded: Gaussians in the order and form that the CPU renderer needs."""

# Kernels take as many parameters as they need: render/kernels.py says why.

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, field, replace

import numpy as np

from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap, Reading, sample_solid
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.render.base import MIN_ALPHA
from gsfeatloc_ros.render.kernels import njit, prange
from gsfeatloc_ros.render.lanes import bits_of_float

# Held while kernels run in parallel: numba's fallback threading layer does not take calls from two threads at once.
KERNEL_LOCK = threading.Lock()

CHUNK = 256
# Rows of a chunk: centre, covariance in the splat frame, log2 of the opacity.
(MEAN_X, MEAN_Y, MEAN_Z, COV_XX, COV_XY, COV_XZ, COV_YY, COV_YZ, COV_ZZ, LOG2_OPACITY) = range(10)
ROWS = 10

_MIN_HALF, _MAX_HALF = np.float32(2.0**-14), np.float32(65504)
_OCTAVE_BITS = 3


@dataclass(frozen=True, eq=False)
class PreparedMap:
    """The Gaussians of a map that can be seen, sorted by size and along a Morton curve, cut into chunks of CHUNK.

    A chunk keeps its Gaussians side by side, so that one instruction treats many of them. The last chunk is filled up
    with Gaussians of opacity 0.

    Attributes:
        gaussians: (chunks, ROWS, CHUNK) float32, splat frame.
        sh: (chunks, 3 C, CHUNK) float16, row 3 k + channel is harmonic k; half precision costs less than the rounding
            to 8-bit colours by far, and halves what a map takes.
        low, high: (chunks, 3) float32, splat frame, the box outside which no Gaussian of the chunk has an alpha of
            MIN_ALPHA.
        antialiased, S_map_splat, reading: as in GaussianMap.
    """

    gaussians: np.ndarray
    sh: np.ndarray
    low: np.ndarray
    high: np.ndarray
    antialiased: bool = False
    S_map_splat: Similarity = field(default_factory=Similarity)
    reading: Reading = field(default_factory=Reading)

    def placed(self, S_map_file: Similarity) -> PreparedMap:
        """Return the same where the frame of its file lies elsewhere in the robot's map frame."""
        return replace(self, S_map_splat=S_map_file @ self.S_map_splat)

    @property
    def sh_coefficients(self) -> int:
        """Number of spherical harmonics per colour channel that are stored."""
        return self.sh.shape[1] // 3

    def solid_points(self, count: int) -> np.ndarray:
        """Return the centres (n, 3) float32, splat frame, of up to `count` Gaussians that cover more than a half."""
        means = self.gaussians[:, MEAN_X : MEAN_Z + 1].transpose(0, 2, 1).reshape(-1, 3)
        return sample_solid(means, np.exp2(self.gaussians[:, LOG2_OPACITY].ravel()), count)

    def unpacked(self, sh_degree: int) -> UnpackedGaussians:
        """Return the Gaussians one by one, in their order, with harmonics up to a degree or as many as there are."""
        used = min(self.sh_coefficients, SH_COEFFICIENTS[sh_degree])
        rows = self.gaussians.transpose(0, 2, 1).reshape(-1, ROWS)
        # Those that fill up the last chunk have no opacity.
        count = np.count_nonzero(np.isfinite(rows[:, LOG2_OPACITY]))
        sh = self.sh[:, : 3 * used].transpose(0, 2, 1).reshape(-1, used, 3)
        return UnpackedGaussians(
            means=np.ascontiguousarray(rows[:count, MEAN_X : MEAN_Z + 1]),
            covariances=np.ascontiguousarray(rows[:count, COV_XX : COV_ZZ + 1]),
            opacities=np.exp2(rows[:count, LOG2_OPACITY]),
            sh=sh[:count],
        )


@dataclass(frozen=True, eq=False)
class UnpackedGaussians:
    """The Gaussians of a prepared map one by one.

    Attributes:
        means: (N, 3) float32, splat frame.
        covariances: (N, 6) float32, splat frame: xx, xy, xz, yy, yz, zz.
        opacities: (N,) float32.
        sh: (N, C, 3) float16, harmonics of the colour.
    """

    means: np.ndarray
    covariances: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray


def prepare(gaussian_map: GaussianMap) -> PreparedMap:
    """Prepare a map for a renderer. The result shares no memory with the map."""
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
    count = np.count_nonzero(seen)
    chunks = -(-count // CHUNK)
    prepared = PreparedMap(
        gaussians=np.empty((chunks, ROWS, CHUNK), dtype=np.float32),
        sh=np.empty((chunks, 3 * sh.shape[1], CHUNK), dtype=np.float16),
        low=np.empty((chunks, 3), dtype=np.float32),
        high=np.empty((chunks, 3), dtype=np.float32),
        antialiased=gaussian_map.antialiased,
        S_map_splat=gaussian_map.S_map_splat,
        reading=gaussian_map.reading,
    )
    # Sorted in the memory that the Gaussians then take: there is least to spare at this time.
    keys = prepared.gaussians.reshape(-1).view(np.uint64)[:count]
    with KERNEL_LOCK:
        order = _drawing_order(seen, means, scales, keys)
        _fill_chunks(
            order,
            means,
            scales,
            rotations,
            opacities,
            sh.reshape(len(sh), 3 * sh.shape[1]),
            prepared.gaussians,
            prepared.sh.view(np.int16),
            prepared.low,
            prepared.high,
        )
    return prepared


def _drawing_order(seen: np.ndarray, means: np.ndarray, scales: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Return the indices (n,) int32 of the Gaussians `seen` (N,) bool, neighbours in space together, small ones first.

    Args:
        keys: (n,) uint64, to work in.
    """
    if len(keys) == 0:
        return np.empty(0, np.int32)
    _list_seen(seen, keys)
    sample = keys[:: 1 + len(keys) // 10_000]
    # Floaters far from everything share the cells at the border, lest all else shares one.
    low, high = np.percentile(means[sample], [1, 99], axis=0)
    low, high = low - (high - low), high + (high - low)
    # A key ends with the index: to sort numbers takes a fraction of the time and of the memory of sorting indices.
    index_bits = len(seen).bit_length()
    morton_bits = (64 - _OCTAVE_BITS - index_bits) // 3
    cell = max(np.max(high - low), np.finfo(np.float32).tiny) / 2**morton_bits
    _make_keys(keys, means, scales, low, cell, np.median(scales[sample].max(axis=1)), morton_bits, index_bits)
    keys.sort()
    keys &= np.uint64((1 << index_bits) - 1)
    return keys.astype(np.int32)


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


@njit
def _half_bits(value):
    """Return the bits, as an int16, of a float32 rounded to half precision; 0 for what is below its normal numbers.

    With whole numbers, as in lanes.load_halves: not all CPUs have an instruction for it.
    """
    if abs(value) < _MIN_HALF:
        return np.int16(0)
    bits = bits_of_float(np.float32(min(max(value, -_MAX_HALF), _MAX_HALF)))
    magnitude = ((bits & np.uint32(0x7FFFFFFF)) + np.uint32(0x1000)) >> np.uint32(13)
    return np.int16((bits >> np.uint32(16) & np.uint32(0x8000)) | (magnitude - np.uint32(112 << 10)))


@njit(parallel=True, nogil=True, cache=True)
def _fill_chunks(order, means, scales, rotations, opacities, sh, gaussians, sh_bits, low, high):
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
                sh_bits[chunk, k, slot] = _half_bits(sh[i, k])
            # How many standard deviations from the centre alpha falls to MIN_ALPHA.
            deviations = math.sqrt(max(2 * math.log(opacities[i] / MIN_ALPHA), 0.0))
            for axis, variance in enumerate((rows[COV_XX, slot], rows[COV_YY, slot], rows[COV_ZZ, slot])):
                mean = means[i, axis]
                # A little more, for the rounding to float32.
                reach = 1.00001 * deviations * math.sqrt(variance) + 1e-6 * abs(mean)
                low[chunk, axis] = min(low[chunk, axis], np.float32(mean - reach))
                high[chunk, axis] = max(high[chunk, axis], np.float32(mean + reach))
