"""Kernels 2 and 3 of a frame: gather the splats of each tile; sort them by depth and blend them into the images."""

# Kernels take as many parameters as they need: render/kernels.py says why.

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import types

from gsfeatloc_ros.render import base
from gsfeatloc_ros.render.kernels import intrinsic, njit, prange
from gsfeatloc_ros.render.lanes import (
    LANES,
    broadcast,
    exp2,
    load,
    lowest_bit,
    mask_bits,
    maximum,
    minimum,
    prefetch,
    select,
    sqrt,
    store,
)
from gsfeatloc_ros.render.project import (
    BLUE,
    CONIC_X,
    CONIC_Y,
    DEPTH,
    GREEN,
    LEFT,
    LOG_OPACITY,
    RED,
    SLANT,
    SPLAT_SIZE,
    TILE,
    X,
    Y,
)

# Lanes are blocks of 4 x 4 pixels: splats are round rather than long, and touch fewer of these than rows of 16.
BLOCK_SIZE = 4
_BLOCKS_X = TILE // BLOCK_SIZE
_BLOCKS = _BLOCKS_X * _BLOCKS_X
# Splats copied beside each other at a time, and then sifted by block: a bit for each.
_BATCH_SIZE = 64

# State of a block's pixels. Depths count from the tile's nearest splat: the spread is a difference of squares.
_TRANSMITTANCE, _COVERED, _RED, _GREEN, _BLUE, _MOMENT1, _MOMENT2, _MEDIAN = range(8)
_STATE_SIZE = 8 * LANES

_F = np.float32
# With an unsigned index numba does not look for negative ones.
_U = np.uint64
_ZERO, _HALF, _ONE = _F(0), _F(0.5), _F(1)
_LOG_MIN_ALPHA, _MAX_ALPHA = _F(math.log2(base.MIN_ALPHA)), _F(base.MAX_ALPHA)
_MIN_TRANSMITTANCE, _DEPTH_MIN_ALPHA = (_F(base.MIN_TRANSMITTANCE), _F(base.DEPTH_MIN_ALPHA))
# Less is as good as nothing, and CPUs are slow at numbers that are almost too small for float32.
_TRANSMITTANCE_FLOOR = _F(1e-30)
_NAN = _F(np.nan)
_COLUMNS = np.tile(np.arange(BLOCK_SIZE, dtype=np.float32), BLOCK_SIZE)
_ROWS = np.repeat(np.arange(BLOCK_SIZE, dtype=np.float32), BLOCK_SIZE)

# Of a digit of the depth sort.
_MAX_DIGIT_BITS = 9


@njit(nogil=True, cache=True)
def tile_starts(histogram):
    """Return where each tile's list starts, (tiles + 1,) int64; set `histogram` to where each thread's part starts."""
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
def gather(pair_tiles, pair_keys, pairs, positions, by_tile):
    """Write each thread's pairs to their tiles' lists; `positions` (threads, tiles) is where, and is advanced."""
    for thread in prange(len(pairs)):
        for pair in range(pairs[thread]):
            tile = pair_tiles[thread, pair]
            by_tile[positions[thread, tile]] = pair_keys[thread, pair]
            positions[thread, tile] += 1


@intrinsic
def _take_next(typingctx, counter):
    """Return counter[0], an int64 that threads share, and add 1 to it."""

    def codegen(context, builder, signature, args):
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), codegen


@njit(parallel=True, nogil=True, cache=True)
def blend(splats, by_tile, starts, threads, background, rgb, depth, median_depth, depth_std, alpha):
    """Sort each tile's splats by depth and blend them front to back into the images.

    Args:
        splats: flat records of SPLAT_SIZE, from `project`.
        by_tile, starts: keys of each tile's splats, from `gather` and `tile_starts`.
        threads: number of workers; each takes the next tile when it is done with one.
        background: (3,) float32.
        rgb (H, W, 3), depth, median_depth, depth_std, alpha (H, W): float32, written.
    """
    tiles = len(starts) - 1
    tiles_x = -(-depth.shape[1] // TILE)
    longest = 0
    for tile in range(tiles):
        longest = max(longest, starts[tile + 1] - starts[tile])
    counter = np.zeros(1, dtype=np.int64)

    for _worker in prange(threads):
        spare = np.empty(longest, dtype=np.uint64)
        state = np.empty(_BLOCKS * _STATE_SIZE, dtype=np.float32)
        while True:
            tile = _take_next(counter)
            if tile >= tiles:
                break
            keys = by_tile[starts[tile] : starts[tile + 1]]
            keys = _sorted_by_depth(keys, spare)
            x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            nearest = splats[_record(keys[0]) + DEPTH] if len(keys) > 0 else _ZERO
            _blend_tile(splats, keys, _F(x0), _F(y0), nearest, state)
            _finish_tile(state, x0, y0, nearest, background, rgb, depth, median_depth, depth_std, alpha)


@njit
def _record(key):
    """Return where the record of the splat with this key is."""
    return np.int64(key & np.uint64(0xFFFFFFFF)) * SPLAT_SIZE


@njit
def _sorted_by_depth(keys, spare):
    """Sort the keys by their upper half, in place or into `spare`: a stable radix sort of the bits that differ."""
    if len(keys) < 2:
        return keys
    shift = np.uint64(32)
    low = high = keys[0] >> shift
    for key in keys:
        low, high = min(low, key >> shift), max(high, key >> shift)
    bits = 0
    while (high - low) >> np.uint64(bits):
        bits += 1
    digits = -(-bits // _MAX_DIGIT_BITS)
    width = -(-bits // max(digits, 1))
    mask = np.uint64((1 << width) - 1)
    counts = np.empty(1 << width, dtype=np.int64)
    a, b = keys, spare[: len(keys)]
    for digit in range(digits):
        down = np.uint64(digit * width)
        counts[:] = 0
        for key in a:
            counts[((key >> shift) - low) >> down & mask] += 1
        total = 0
        for value in range(len(counts)):
            count = counts[value]
            counts[value] = total
            total += count
        for key in a:
            value = ((key >> shift) - low) >> down & mask
            b[counts[value]] = key
            counts[value] += 1
        a, b = b, a
    return a


@njit
def _blend_tile(splats, keys, x0, y0, nearest, state):
    """Blend splats, nearest first, into the state (_BLOCKS, _STATE_SIZE) of a tile whose first pixel is x0, y0."""
    state[:] = _ZERO
    for block in range(_BLOCKS):
        store(state, block * _STATE_SIZE + _TRANSMITTANCE * LANES, broadcast(_ONE))
    batch = np.empty(_BATCH_SIZE * SPLAT_SIZE, dtype=np.float32)
    members = np.empty(_BLOCKS, dtype=np.uint64)
    running = np.ones(_BLOCKS, dtype=np.bool_)
    for first in range(0, len(keys), _BATCH_SIZE):
        count = min(_BATCH_SIZE, len(keys) - first)
        # The records of the batch after this one come from memory while this one is blended.
        for key in keys[first + _BATCH_SIZE : first + 2 * _BATCH_SIZE]:
            prefetch(splats, _record(key))
        for k in range(count):
            store(batch, k * SPLAT_SIZE, load(splats, _record(keys[first + k])))
        _find_members(batch, count, x0, y0, members)
        any_running = False
        for block in range(_BLOCKS):
            if running[block]:
                x, y = x0 + _F(block % _BLOCKS_X * BLOCK_SIZE), y0 + _F(block // _BLOCKS_X * BLOCK_SIZE)
                running[block] = _blend_block(batch, members[block], x, y, nearest, state, block * _STATE_SIZE)
                any_running |= running[block]
        if not any_running:
            break


@njit
def _find_members(batch, count, x0, y0, members):
    """Set, for each block of the tile at x0, y0, a bit for each of the first `count` splats in `batch` that touch it.

    Without a branch on what each splat touches: that cannot be predicted.
    """
    boxes = np.empty((4, _BATCH_SIZE), dtype=np.float32)
    for k in range(_BATCH_SIZE):
        at = _U(k) * _U(SPLAT_SIZE)
        for side in range(4):
            boxes[side, k] = batch[at + _U(LEFT + side)]
    flat = boxes.reshape(-1)
    columns, rows = np.zeros(_BLOCKS_X, dtype=np.uint64), np.zeros(_BLOCKS_X, dtype=np.uint64)
    for group in range(0, _BATCH_SIZE, LANES):
        left, right = load(flat, group), load(flat, _BATCH_SIZE + group)
        top, bottom = load(flat, 2 * _BATCH_SIZE + group), load(flat, 3 * _BATCH_SIZE + group)
        for i in range(_BLOCKS_X):
            first, last = _F(i * BLOCK_SIZE), _F(i * BLOCK_SIZE + BLOCK_SIZE - 1)
            in_column = mask_bits((left <= x0 + last) & (right >= x0 + first))
            in_row = mask_bits((top <= y0 + last) & (bottom >= y0 + first))
            columns[i] |= _U(in_column) << _U(group)
            rows[i] |= _U(in_row) << _U(group)
    among = _U(0xFFFFFFFFFFFFFFFF) >> _U(_BATCH_SIZE - count)
    for block in range(_BLOCKS):
        members[block] = columns[block % _BLOCKS_X] & rows[block // _BLOCKS_X] & among


@njit
def _blend_block(batch, members, x0, y0, nearest, state, at):
    """Blend the splats in `batch` that have a bit in `members` into a block of pixels.

    The block's first pixel is x0, y0, and its state is at `at`. Return whether any of its rays goes on.
    """
    columns, rows = load(_COLUMNS, 0) + x0, load(_ROWS, 0) + y0
    transmittance = load(state, at + _TRANSMITTANCE * LANES)
    covered = load(state, at + _COVERED * LANES)
    red, green = load(state, at + _RED * LANES), load(state, at + _GREEN * LANES)
    blue, median = load(state, at + _BLUE * LANES), load(state, at + _MEDIAN * LANES)
    moment1, moment2 = load(state, at + _MOMENT1 * LANES), load(state, at + _MOMENT2 * LANES)
    while members:
        k = _U(lowest_bit(members)) * _U(SPLAT_SIZE)
        members &= members - _U(1)
        dx, dy = columns - batch[k + _U(X)], rows - batch[k + _U(Y)]
        dx = dx - dy * batch[k + _U(SLANT)]
        log_alpha = dx * dx * batch[k + _U(CONIC_X)] + (dy * dy * batch[k + _U(CONIC_Y)] + batch[k + _U(LOG_OPACITY)])
        alpha = select(log_alpha >= _LOG_MIN_ALPHA, minimum(exp2(log_alpha), _MAX_ALPHA), _ZERO)
        after = transmittance * (_ONE - alpha)
        # It only falls: a ray that has ended remains so.
        weight = select(after > _MIN_TRANSMITTANCE, transmittance * alpha, _ZERO)
        z = batch[k + _U(DEPTH)] - nearest
        median = select((transmittance > _HALF) & (after <= _HALF), z, median)
        transmittance = maximum(after, _TRANSMITTANCE_FLOOR)
        covered = covered + weight
        red = red + weight * batch[k + _U(RED)]
        green = green + weight * batch[k + _U(GREEN)]
        blue = blue + weight * batch[k + _U(BLUE)]
        moment1 = moment1 + weight * z
        moment2 = moment2 + weight * z * z
    store(state, at + _TRANSMITTANCE * LANES, transmittance)
    store(state, at + _COVERED * LANES, covered)
    store(state, at + _RED * LANES, red)
    store(state, at + _GREEN * LANES, green)
    store(state, at + _BLUE * LANES, blue)
    store(state, at + _MOMENT1 * LANES, moment1)
    store(state, at + _MOMENT2 * LANES, moment2)
    store(state, at + _MEDIAN * LANES, median)
    return mask_bits(transmittance > _MIN_TRANSMITTANCE) != 0


@njit
def _finish_tile(state, x0, y0, nearest, background, rgb, depth, median_depth, depth_std, alpha):
    """Write a tile's state to the images."""
    height, width = depth.shape
    for block in range(_BLOCKS):
        at = block * _STATE_SIZE
        covered = minimum(load(state, at + _COVERED * LANES), _ONE)
        store(state, at + _COVERED * LANES, covered)
        uncovered = _ONE - covered
        for channel in range(3):
            color = load(state, at + (_RED + channel) * LANES) + uncovered * background[channel]
            store(state, at + (_RED + channel) * LANES, minimum(color, _ONE))
        has_depth = covered >= _DEPTH_MIN_ALPHA
        mean = load(state, at + _MOMENT1 * LANES) / covered
        variance = load(state, at + _MOMENT2 * LANES) / covered - mean * mean
        median = load(state, at + _MEDIAN * LANES)
        store(state, at + _MOMENT1 * LANES, select(has_depth, mean + nearest, _NAN))
        store(state, at + _MOMENT2 * LANES, select(has_depth, sqrt(maximum(variance, _ZERO)), _NAN))
        store(state, at + _MEDIAN * LANES, select(has_depth, median + nearest, _NAN))
        left, top = x0 + block % _BLOCKS_X * BLOCK_SIZE, y0 + block // _BLOCKS_X * BLOCK_SIZE
        for y in range(top, min(top + BLOCK_SIZE, height)):
            for x in range(left, min(left + BLOCK_SIZE, width)):
                pixel = at + (y - top) * BLOCK_SIZE + x - left
                alpha[y, x] = state[pixel + _COVERED * LANES]
                rgb[y, x, 0] = state[pixel + _RED * LANES]
                rgb[y, x, 1] = state[pixel + _GREEN * LANES]
                rgb[y, x, 2] = state[pixel + _BLUE * LANES]
                depth[y, x] = state[pixel + _MOMENT1 * LANES]
                depth_std[y, x] = state[pixel + _MOMENT2 * LANES]
                median_depth[y, x] = state[pixel + _MEDIAN * LANES]
