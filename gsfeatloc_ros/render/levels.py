"""The coarser levels of a large map: Gaussians that each stand for four, for what is seen small."""

# Kernels take as many parameters as they need: common/kernels.py says why.

from __future__ import annotations

import math

import numpy as np

from gsfeatloc_ros.common.kernels import njit, prange
from gsfeatloc_ros.render.base import EPS2D, MAX_ALPHA, MIN_ALPHA
from gsfeatloc_ros.render.chunks import (
    BRANCHING,
    CHUNK,
    COV_XX,
    COV_XY,
    COV_XZ,
    COV_YY,
    COV_YZ,
    COV_ZZ,
    KERNEL_LOCK,
    LOG2_OPACITY,
    MAX_LOG2_OPACITY,
    MEAN_X,
    PreparedMap,
)
from gsfeatloc_ros.render.store import grow_box, half_bits

# A chunk of merged Gaussians is drawn where they are seen no larger than this, one standard deviation in pixels: they
# are then within the blur that every splat gets.
MAX_SIZE = math.sqrt(EPS2D)
# As large they are seen about where they are drawn: from there on to half of it the next level is not yet fine enough.
_USUAL_SIZE = 0.75 * MAX_SIZE
# Chunks that are made while kernels of others wait.
_AT_ONCE = 1024
# Of a Gaussian whose alpha is MIN_ALPHA at its centre: not nothing, lest four of them be.
_MIN_MASS = 1e-6

# Gaussians by log2 of the opacity, in steps, and their mass: the integral of -ln(1 - alpha) over the plane in which the
# Gaussian's exponent is u^2 / 2, but for 2 pi. It is what adds up where they lie behind one another.
_STEP = 1.0 / 32
_LOG2_OPACITIES = np.arange(math.log2(MIN_ALPHA), MAX_LOG2_OPACITY + _STEP, _STEP)
_DENSITY = -np.log1p(-np.minimum(np.exp2(_LOG2_OPACITIES), MAX_ALPHA))
_MASSES = _MIN_MASS + np.concatenate([[0.0], np.cumsum(0.5 * (_DENSITY[1:] + _DENSITY[:-1]))]) * _STEP * math.log(2.0)
# Values of float16 by their bits.
_HALVES = np.arange(1 << 16, dtype=np.uint32).astype(np.uint16).view(np.float16).astype(np.float32)


def merge_levels(prepared: PreparedMap) -> None:
    """Fill the coarser levels of a map whose leaves are there.

    Each chunk is made of BRANCHING neighbours of the level before: their Gaussians are put together by fours that are
    near each other. A merged one has the mean, the covariance and the colours of what it stands for, weighted by mass,
    and as much of it at the distance where it is drawn: what is then seen through four is seen through it.
    """
    starts = prepared.level_starts
    for level in range(1, len(starts) - 1):
        for begin in range(starts[level], starts[level + 1], _AT_ONCE):
            made = slice(begin, min(begin + _AT_ONCE, starts[level + 1]))
            first = starts[level - 1] + (begin - starts[level]) * BRANCHING
            children = slice(first, min(first + BRANCHING * _AT_ONCE, starts[level]))
            # Of a map in a file they are copies.
            gaussians, sh = prepared.gaussians[made], prepared.sh[made]
            with KERNEL_LOCK:
                _merge(
                    prepared.gaussians[children],
                    prepared.sh[children].view(np.int16),
                    (prepared.low[children], prepared.high[children]),
                    gaussians,
                    sh.view(np.int16),
                    (prepared.low[made], prepared.high[made]),
                    prepared.sizes[made],
                    0.0 if prepared.antialiased else EPS2D / _USUAL_SIZE**2,
                    _HALVES,
                )
            prepared.gaussians[made], prepared.sh[made] = gaussians, sh


@njit(parallel=True, nogil=True, cache=True)
def _merge(children, children_sh, children_boxes, gaussians, sh_bits, boxes, sizes, blur, halves):
    """Make chunks of those of the level before.

    Args:
        children, children_sh: gaussians, and sh as int16, of the chunks that they are made of, BRANCHING each.
        children_boxes: their low and high.
        gaussians, sh_bits, sizes: of those that are made; written.
        boxes: their low and high; written.
        blur: variance of the blur where merged Gaussians are drawn, in squares of their size.
        halves: _HALVES.
    """
    for chunk in prange(len(gaussians)):
        begin, end = chunk * BRANCHING, min((chunk + 1) * BRANCHING, len(children))
        places, means = _gathered(begin, end, children)
        groups = -(-len(places) // BRANCHING)
        _group(means, places, groups)
        size = _size(means, places, groups, children)
        made = gaussians[chunk], sh_bits[chunk]
        _fill(*made, means, places, groups, children, children_sh, blur * size * size, halves)
        sizes[chunk] = size
        low, high = boxes[0][chunk], boxes[1][chunk]
        for axis in range(3):
            low[axis] = children_boxes[0][begin:end, axis].min()
            high[axis] = children_boxes[1][begin:end, axis].max()
        for slot in range(groups):
            deviations = math.sqrt(2 * (gaussians[chunk, LOG2_OPACITY, slot] - _LOG2_OPACITIES[0]) * math.log(2.0))
            grow_box(gaussians[chunk], slot, deviations, low, high)


@njit
def _gathered(begin, end, gaussians):
    """Return chunk and slot (n, 2) and means (n, 3) of the Gaussians of some chunks, without those that fill up."""
    places, means = np.empty((BRANCHING * CHUNK, 2), np.int64), np.empty((BRANCHING * CHUNK, 3), np.float64)
    count = 0
    for chunk in range(begin, end):
        for slot in range(CHUNK):
            if gaussians[chunk, LOG2_OPACITY, slot] > -np.inf:
                places[count, 0], places[count, 1] = chunk, slot
                for axis in range(3):
                    means[count, axis] = gaussians[chunk, MEAN_X + axis, slot]
                count += 1
    return places[:count], means[:count]


@njit
def _bounds(group, groups, count):
    """Return where in `count` Gaussians a group begins, of `groups` of nearly as many each."""
    return group * count // groups


@njit
def _group(means, places, groups):
    """Sort Gaussians so that groups of neighbours follow each other: halve them along their longer side, and again."""
    count = len(means)
    stack = np.empty((64, 2), np.int64)
    stack[0, 0], stack[0, 1] = 0, groups
    height = 1
    while height:
        height -= 1
        first, last = stack[height]
        if last - first < 2:
            continue
        middle = (first + last) // 2
        begin, end = _bounds(first, groups, count), _bounds(last, groups, count)
        longest, axis = -1.0, 0
        for candidate in range(3):
            lowest = highest = means[begin, candidate]
            for i in range(begin + 1, end):
                lowest, highest = min(lowest, means[i, candidate]), max(highest, means[i, candidate])
            if highest - lowest > longest:
                longest, axis = highest - lowest, candidate
        _select(means, places, axis, begin, end - 1, _bounds(middle, groups, count))
        stack[height, 0], stack[height, 1] = first, middle
        stack[height + 1, 0], stack[height + 1, 1] = middle, last
        height += 2


@njit
def _select(means, places, axis, left, right, wanted):
    """Put Gaussians so that those before `wanted` are at most as far along an axis as it, those behind at least."""
    while left < right:
        pivot = means[(left + right) // 2, axis]
        i, j = left, right
        while i <= j:
            while means[i, axis] < pivot:
                i += 1
            while means[j, axis] > pivot:
                j -= 1
            if i <= j:
                for k in range(3):
                    means[i, k], means[j, k] = means[j, k], means[i, k]
                for k in range(2):
                    places[i, k], places[j, k] = places[j, k], places[i, k]
                i, j = i + 1, j - 1
        if wanted <= j:
            right = j
        elif wanted >= i:
            left = i
        else:
            return


@njit
def _size(means, places, groups, gaussians):
    """Return one standard deviation of what groups hold, the root of the mean square; splats have two such axes."""
    total = 0.0
    for group in range(groups):
        begin, end = _bounds(group, groups, len(means)), _bounds(group + 1, groups, len(means))
        for axis, row in enumerate((COV_XX, COV_YY, COV_ZZ)):
            mean = square = 0.0
            for i in range(begin, end):
                mean += means[i, axis] / (end - begin)
                square += gaussians[places[i, 0], row, places[i, 1]] / (end - begin)
            for i in range(begin, end):
                square += (means[i, axis] - mean) ** 2 / (end - begin)
            total += square
    return math.sqrt(0.5 * total / max(groups, 1))


@njit
def _area(xx, xy, xz, yy, yz, zz):
    """Return how large a Gaussian is seen, but for 2 pi: root mean square over all directions, times root 3."""
    minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    return math.sqrt(max(minors, 1e-60))


@njit
def _mass_of(log2_opacity):
    place = (log2_opacity - _LOG2_OPACITIES[0]) / _STEP
    index = min(max(int(place), 0), len(_MASSES) - 2)
    return _MASSES[index] + min(max(place - index, 0.0), 1.0) * (_MASSES[index + 1] - _MASSES[index])


@njit
def _log2_opacity_of(mass):
    index = min(max(int(np.searchsorted(_MASSES, mass)) - 1, 0), len(_MASSES) - 2)
    share = (mass - _MASSES[index]) / (_MASSES[index + 1] - _MASSES[index])
    return min(_LOG2_OPACITIES[0] + _STEP * (index + min(max(share, 0.0), 1.0)), MAX_LOG2_OPACITY)


@njit
def _fill(merged, merged_sh, means, places, groups, gaussians, sh_bits, blur, halves):
    """Write the merged Gaussians of all groups to a chunk, and fill it up. `blur` is a variance, splat units."""
    merged[:] = 0.0
    merged[LOG2_OPACITY] = -np.inf
    merged_sh[:] = 0
    weights = np.empty(2 * BRANCHING)
    cov = np.empty(6)
    mean = np.empty(3)
    for group in range(groups):
        begin, end = _bounds(group, groups, len(means)), _bounds(group + 1, groups, len(means))
        total = 0.0
        for i in range(begin, end):
            rows, slot = gaussians[places[i, 0]], places[i, 1]
            area = _area(
                rows[COV_XX, slot] + blur,
                rows[COV_XY, slot],
                rows[COV_XZ, slot],
                rows[COV_YY, slot] + blur,
                rows[COV_YZ, slot],
                rows[COV_ZZ, slot] + blur,
            )
            weights[i - begin] = _mass_of(rows[LOG2_OPACITY, slot]) * area
            total += weights[i - begin]
        mean[:], cov[:] = 0.0, 0.0
        for i in range(begin, end):
            for axis in range(3):
                mean[axis] += weights[i - begin] / total * means[i, axis]
        for i in range(begin, end):
            share = weights[i - begin] / total
            x, y, z = means[i, 0] - mean[0], means[i, 1] - mean[1], means[i, 2] - mean[2]
            scatter = (x * x, x * y, x * z, y * y, y * z, z * z)
            for k in range(6):
                cov[k] += share * (gaussians[places[i, 0], COV_XX + k, places[i, 1]] + scatter[k])
        area = _area(cov[0] + blur, cov[1], cov[2], cov[3] + blur, cov[4], cov[5] + blur)
        for axis in range(3):
            merged[MEAN_X + axis, group] = mean[axis]
        for k in range(6):
            merged[COV_XX + k, group] = cov[k]
        merged[LOG2_OPACITY, group] = _log2_opacity_of(total / area)
        for k in range(sh_bits.shape[1]):
            value = 0.0
            for i in range(begin, end):
                value += weights[i - begin] / total * halves[np.uint16(sh_bits[places[i, 0], k, places[i, 1]])]
            merged_sh[k, group] = half_bits(np.float32(value))
