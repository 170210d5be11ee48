"""Sort the splats of a tile by depth."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.kernels import njit

# Of a digit of the sort.
_DIGIT_BITS = 8
_DIGITS = 1 << _DIGIT_BITS
# With an unsigned index numba does not look for negative ones, and for what an array yields by itself it multiplies.
_U = np.uint64
_DEPTH_SHIFT = _U(32)
# Moves for each key after which the last bits are sorted by digits too.
_MAX_MOVES = 8


@njit
def sorted_by_depth(keys, spare):
    """Sort keys by their upper half, which is the depth's bits; return them in `keys` or in `spare`, as long or longer.

    Stable: keys of one depth stay in their order. A radix sort of the two highest digits in which depths differ leaves
    few keys out of order; those are moved one by one.
    """
    if len(keys) < 2:
        return keys
    low = high = keys[0] >> _DEPTH_SHIFT
    for i in range(len(keys)):
        depth = keys[_U(i)] >> _DEPTH_SHIFT
        low, high = min(low, depth), max(high, depth)
    bits = 0
    while (high - low) >> _U(bits):
        bits += 1
    spare = spare[: len(keys)]
    shift = max(bits - 2 * _DIGIT_BITS, 0)
    _sort_two_digits(keys, spare, low, shift)
    if shift == 0 or _insert_each(keys):
        return keys
    # Nearly all depths are alike: from the lowest digit up.
    for shift in range(0, bits, 2 * _DIGIT_BITS):
        _sort_two_digits(keys, spare, low, shift)
    return keys


@njit
def _sort_two_digits(keys, spare, low, shift):
    """Sort by two digits of the depth above `low`, from the bit `shift` up: into `spare` by the lower, and back."""
    counts, upper_counts = np.zeros(_DIGITS, dtype=np.uint32), np.zeros(_DIGITS, dtype=np.uint32)
    down, upper_down = _U(shift), _U(shift + _DIGIT_BITS)
    mask = _U(_DIGITS - 1)
    for i in range(len(keys)):
        depth = (keys[_U(i)] >> _DEPTH_SHIFT) - low
        counts[depth >> down & mask] += np.uint32(1)
        upper_counts[depth >> upper_down & mask] += np.uint32(1)
    total = upper_total = np.uint32(0)
    for digit in range(_DIGITS):
        count, upper_count = counts[digit], upper_counts[digit]
        counts[digit], upper_counts[digit] = total, upper_total
        total += count
        upper_total += upper_count
    for i in range(len(keys)):
        key = keys[_U(i)]
        digit = ((key >> _DEPTH_SHIFT) - low) >> down & mask
        spare[counts[digit]] = key
        counts[digit] += np.uint32(1)
    for i in range(len(keys)):
        key = spare[_U(i)]
        digit = ((key >> _DEPTH_SHIFT) - low) >> upper_down & mask
        keys[upper_counts[digit]] = key
        upper_counts[digit] += np.uint32(1)


@njit
def _insert_each(keys):
    """Sort nearly sorted keys by moving each to its place; return False where that takes too long, in some order."""
    moves = 0
    for i in range(1, len(keys)):
        key = keys[_U(i)]
        if keys[_U(i - 1)] >> _DEPTH_SHIFT <= key >> _DEPTH_SHIFT:
            continue
        place = i
        while place > 0 and keys[place - 1] >> _DEPTH_SHIFT > key >> _DEPTH_SHIFT:
            keys[place] = keys[place - 1]
            place -= 1
        keys[place] = key
        moves += i - place
        if moves > _MAX_MOVES * len(keys):
            return False
    return True
