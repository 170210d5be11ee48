"""Which chunks of a map a view is drawn from: all that it may see, or coarser ones where these are seen small."""

# Kernels take as many parameters as they need: common/kernels.py says why.

from __future__ import annotations

import math

import numpy as np

from gsfeatloc_ros.common.kernels import njit
from gsfeatloc_ros.render.base import NEAR_PLANE
from gsfeatloc_ros.render.camera_view import CameraView, frustum, is_outside, visible_chunks
from gsfeatloc_ros.render.chunks import BRANCHING, CHUNK, LARGE_MAP, PreparedMap
from gsfeatloc_ros.render.levels import MAX_SIZE

# A view of a large map is drawn from no more chunks, a million Gaussians: memory and time have this bound. Where it
# would see more, merged Gaussians may be larger by such steps, until it does not.
MAX_CHUNKS = LARGE_MAP // CHUNK
_LARGER, _STEPS = math.sqrt(2.0), 40
# More than a path from the coarsest level to the finest leaves undone on its way.
_STACK_SIZE = 128


class Cut:
    """The boxes of a map's chunks, and the levels that they are of.

    Args:
        prepared: the map.
        max_chunks: that a view is drawn from, of a map with coarser levels.
    """

    def __init__(self, prepared: PreparedMap, max_chunks: int = MAX_CHUNKS) -> None:
        self._max_chunks = max_chunks
        self._low, self._high, self._sizes = prepared.low, prepared.high, prepared.sizes
        self._starts = prepared.level_starts

    def chunks(self, view: CameraView) -> np.ndarray:
        """Return the indices (n,) int64 of the chunks that `view` is drawn from, in the order of the leaves.

        Of a map of one level they are those that it may see. Of others, a chunk takes the place of the leaves that it
        stands for where its Gaussians are seen no larger than MAX_SIZE pixels, the nearest of them as well; where those
        are too many chunks, where they are seen no larger than is needed for fewer.
        """
        if len(self._starts) == 2:
            return visible_chunks(view, self._low, self._high)
        scale, sides = float(max(view.fx, view.fy)) / MAX_SIZE, frustum(view)
        boxes = (self._low, self._high, self._sizes, self._starts)
        # At last any size will do: a merged Gaussian may be infinite.
        for scale in (*(scale / _LARGER**step for step in range(_STEPS)), 0.0):
            chunks = _cut(*boxes, view.origin, view.forward, scale, *sides, self._max_chunks)
            if len(chunks) <= self._max_chunks:
                break
        return chunks


@njit(nogil=True, cache=True)
def _cut(low, high, sizes, starts, origin, forward, scale, inward, margins, limits, max_chunks):
    """Return the chunks, or more than `max_chunks` of them; `scale` is the focal length in the largest size allowed."""
    levels = len(starts) - 1
    chunks = np.empty(starts[1], dtype=np.int64)
    count = 0
    stack = np.empty((_STACK_SIZE, 2), dtype=np.int64)
    stack[0, 0], stack[0, 1] = levels - 1, starts[levels - 1]
    height = 1
    while height and count <= max_chunks:
        height -= 1
        level, chunk = stack[height]
        if is_outside(low[chunk], high[chunk], origin, inward, margins, limits):
            continue
        # Nothing before the near plane is drawn.
        depth = max(_least_depth(low[chunk], high[chunk], origin, forward), NEAR_PLANE)
        if level == 0 or scale == 0.0 or scale * sizes[chunk] <= depth:
            chunks[count] = chunk
            count += 1
            continue
        first = starts[level - 1] + (chunk - starts[level]) * BRANCHING
        last = min(first + BRANCHING, starts[level]) - 1
        # The first on top: leaves stay in their order.
        for child in range(last, first - 1, -1):
            stack[height, 0], stack[height, 1] = level - 1, child
            height += 1
    return chunks[:count]


@njit
def _least_depth(low, high, origin, forward):
    """Return the least depth of a box, `low` to `high` (3,), before a camera."""
    depth = 0.0
    for axis in range(3):
        corner = low[axis] if forward[axis] > 0.0 else high[axis]
        depth += forward[axis] * (corner - origin[axis])
    return depth
