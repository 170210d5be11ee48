"""Kernels 2 and 3 of a frame: gather the splats of each tile; sort them by depth and blend them into the images."""

# Kernels take as many parameters as they need: common/kernels.py says why.

from __future__ import annotations

import math

import numpy as np
from llvmlite import ir
from numba import types

from gsfeatloc_ros.common.kernels import intrinsic, njit, prange
from gsfeatloc_ros.common.lanes import (
    LANES,
    SQUARE,
    broadcast,
    exp2,
    load,
    lowest_bit,
    mask_bits,
    mask_from_bits,
    maximum,
    minimum,
    minus_product,
    prefetch,
    select,
    sqrt,
    store,
    store_rows,
    store_square,
)
from gsfeatloc_ros.render import base
from gsfeatloc_ros.render.batch import BATCH_ROWS, BATCH_SIZE, BLOCKS, BLOCKS_X, DEPTH2, load_batch, record
from gsfeatloc_ros.render.depth_sort import sorted_by_depth
from gsfeatloc_ros.render.project import BLUE, CONIC_X, CONIC_Y, DEPTH, GREEN, LOG_OPACITY, RED, SLANT, TILE, X, Y

# State of a block's pixels. Depths count from the tile's nearest splat: the spread is a difference of squares.
_TRANSMITTANCE, _RED, _GREEN, _BLUE, _MOMENT1, _MOMENT2, _MEDIAN = range(7)
_STATE_SIZE = 7 * LANES
_ALL_LANES = np.uint32((1 << LANES) - 1)

_F = np.float32
# With an unsigned index numba does not look for negative ones.
_U = np.uint64
_ZERO, _HALF, _ONE = _F(0), _F(0.5), _F(1)
_LOG_MIN_ALPHA, _MAX_ALPHA = _F(math.log2(base.MIN_ALPHA)), _F(base.MAX_ALPHA)
_MIN_TRANSMITTANCE, _DEPTH_MIN_ALPHA = (_F(base.MIN_TRANSMITTANCE), _F(base.DEPTH_MIN_ALPHA))
_NAN = _F(np.nan)
_COLUMNS = np.tile(np.arange(SQUARE, dtype=np.float32), SQUARE)
_ROWS = np.repeat(np.arange(SQUARE, dtype=np.float32), SQUARE)
# Records fetched ahead at each block, so that all of the next batch are after the last one.
_AHEAD = BATCH_SIZE // BLOCKS


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
        tiles, keys, places = pair_tiles[thread], pair_keys[thread], positions[thread]
        for pair in range(pairs[thread]):
            tile = _U(tiles[_U(pair)])
            place = places[tile]
            by_tile[_U(place)] = keys[_U(pair)]
            places[tile] = place + 1


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
        state = np.empty(BLOCKS * _STATE_SIZE, dtype=np.float32)
        while True:
            tile = _take_next(counter)
            if tile >= tiles:
                break
            keys = sorted_by_depth(by_tile[starts[tile] : starts[tile + 1]], spare)
            x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            nearest = splats[record(keys[0]) + DEPTH] if len(keys) > 0 else _ZERO
            _blend_tile(splats, keys, _F(x0), _F(y0), nearest, state)
            _finish_tile(state, x0, y0, nearest, background, rgb, depth, median_depth, depth_std, alpha)


@njit
def _blend_tile(splats, keys, x0, y0, nearest, state):
    """Blend splats, nearest first, into the state (BLOCKS, _STATE_SIZE) of a tile whose first pixel is x0, y0."""
    state[:] = _ZERO
    for block in range(BLOCKS):
        store(state, block * _STATE_SIZE + _TRANSMITTANCE * LANES, broadcast(_ONE))
    starts = np.empty(BATCH_SIZE, dtype=np.int64)
    batch = np.empty(BATCH_ROWS * BATCH_SIZE, dtype=np.float32)
    members = np.empty(BLOCKS, dtype=np.uint64)
    running = np.full(BLOCKS, _ALL_LANES)
    for first in range(0, len(keys), BATCH_SIZE):
        load_batch(splats, keys, first, x0, y0, nearest, starts, batch, members)
        any_running = False
        for block in range(BLOCKS):
            # The records of the next batch come from memory while this one is blended.
            ahead = first + BATCH_SIZE + block * _AHEAD
            for place in range(ahead, min(ahead + _AHEAD, len(keys))):
                prefetch(splats, record(keys[_U(place)]))
            if running[block]:
                x, y = x0 + _F(block % BLOCKS_X * SQUARE), y0 + _F(block // BLOCKS_X * SQUARE)
                running[block] = _blend_block(batch, members[block], x, y, running[block], state, block * _STATE_SIZE)
                any_running |= running[block] != 0
        if not any_running:
            break


@njit
def _blend_block(batch, members, x0, y0, running, state, at):
    """Blend the splats in `batch` that have a bit in `members` into a block of pixels.

    The block's first pixel is x0, y0, and its state is at `at`. `running` has a bit for each ray that goes on; return
    those that still do.
    """
    columns, rows = load(_COLUMNS, 0) + x0, load(_ROWS, 0) + y0
    running = mask_from_bits(running)
    transmittance, median = load(state, at + _TRANSMITTANCE * LANES), load(state, at + _MEDIAN * LANES)
    red, green, blue = (
        load(state, at + _RED * LANES),
        load(state, at + _GREEN * LANES),
        load(state, at + _BLUE * LANES),
    )
    moment1, moment2 = load(state, at + _MOMENT1 * LANES), load(state, at + _MOMENT2 * LANES)
    while members:
        k = _U(lowest_bit(members))
        members &= members - _U(1)
        dx, dy = columns - batch[k + _U(X * BATCH_SIZE)], rows - batch[k + _U(Y * BATCH_SIZE)]
        dx = dx - dy * batch[k + _U(SLANT * BATCH_SIZE)]
        log_alpha = dx * dx * batch[k + _U(CONIC_X * BATCH_SIZE)] + (
            dy * dy * batch[k + _U(CONIC_Y * BATCH_SIZE)] + batch[k + _U(LOG_OPACITY * BATCH_SIZE)]
        )
        alpha = select(log_alpha >= _LOG_MIN_ALPHA, minimum(exp2(log_alpha), _MAX_ALPHA), _ZERO)
        weight = transmittance * alpha
        after = minus_product(transmittance, transmittance, alpha)
        running = running & (after > _MIN_TRANSMITTANCE)
        # At last that of the splat at which the transmittance falls to a half.
        median = select(transmittance > _HALF, batch[k + _U(DEPTH * BATCH_SIZE)], median)
        transmittance = select(running, after, transmittance)
        red = select(running, red + weight * batch[k + _U(RED * BATCH_SIZE)], red)
        green = select(running, green + weight * batch[k + _U(GREEN * BATCH_SIZE)], green)
        blue = select(running, blue + weight * batch[k + _U(BLUE * BATCH_SIZE)], blue)
        moment1 = select(running, moment1 + weight * batch[k + _U(DEPTH * BATCH_SIZE)], moment1)
        moment2 = select(running, moment2 + weight * batch[k + _U(DEPTH2 * BATCH_SIZE)], moment2)
    store(state, at + _TRANSMITTANCE * LANES, transmittance)
    store(state, at + _MEDIAN * LANES, median)
    store(state, at + _RED * LANES, red)
    store(state, at + _GREEN * LANES, green)
    store(state, at + _BLUE * LANES, blue)
    store(state, at + _MOMENT1 * LANES, moment1)
    store(state, at + _MOMENT2 * LANES, moment2)
    return mask_bits(running)


@njit
def _finish_tile(state, x0, y0, nearest, background, rgb, depth, median_depth, depth_std, alpha):
    """Write a tile's state to the images."""
    height, width = depth.shape
    for block in range(BLOCKS):
        at = block * _STATE_SIZE
        uncovered = load(state, at + _TRANSMITTANCE * LANES)
        covered = _ONE - uncovered
        red = minimum(load(state, at + _RED * LANES) + uncovered * background[0], _ONE)
        green = minimum(load(state, at + _GREEN * LANES) + uncovered * background[1], _ONE)
        blue = minimum(load(state, at + _BLUE * LANES) + uncovered * background[2], _ONE)
        has_depth = covered >= _DEPTH_MIN_ALPHA
        mean = load(state, at + _MOMENT1 * LANES) / covered
        variance = load(state, at + _MOMENT2 * LANES) / covered - mean * mean
        spread = select(has_depth, sqrt(maximum(variance, _ZERO)), _NAN)
        median = select(has_depth, load(state, at + _MEDIAN * LANES) + nearest, _NAN)
        mean = select(has_depth, mean + nearest, _NAN)
        left, top = x0 + block % BLOCKS_X * SQUARE, y0 + block // BLOCKS_X * SQUARE
        if left + SQUARE <= width and top + SQUARE <= height:
            place = top * width + left
            store_square(rgb, 3 * place, 3 * width, (red, green, blue))
            store_square(depth, place, width, (mean,))
            store_square(median_depth, place, width, (median,))
            store_square(depth_std, place, width, (spread,))
            store_square(alpha, place, width, (covered,))
            continue
        # At the images' right or lower border, or beyond.
        store_rows(state, at, LANES, (red, green, blue, mean, median, spread, covered))
        for y in range(top, min(top + SQUARE, height)):
            for x in range(left, min(left + SQUARE, width)):
                pixel = at + (y - top) * SQUARE + x - left
                for channel in range(3):
                    rgb[y, x, channel] = state[pixel + channel * LANES]
                depth[y, x], median_depth[y, x] = state[pixel + 3 * LANES], state[pixel + 4 * LANES]
                depth_std[y, x], alpha[y, x] = state[pixel + 5 * LANES], state[pixel + 6 * LANES]
