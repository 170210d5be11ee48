"""Which chunks of a map a view is drawn from: all that it may see, or coarser ones where these are seen small."""

# Kernels take as many parameters as they need: common/kernels.py says why.

from __future__ import annotations

import math

import numpy as np

from gsfeatloc_ros.common.kernels import njit
from gsfeatloc_ros.render.base import NEAR_PLANE
from gsfeatloc_ros.render.camera_view import CameraView, frustum, is_outside, visible_chunks
from gsfeatloc_ros.render.chunks import BRANCHING, MAX_CHUNKS, PreparedMap
from gsfeatloc_ros.render.levels import MAX_SIZE

# A view of so many pixels is drawn from so many chunks at most, half a million Gaussians, which takes about as long as
# one in a map of a million. Of other views the bound goes with the root: coarse ones need what is near as well.
_PIXELS, _CHUNKS = 640 * 480, 2048
# Where there would be more, merged Gaussians may be larger the farther they are beyond some depth: what stands near
# hides much of what lies behind. That depth is found by so many halvings between these.
_HALVINGS, _LEAST, _FARTHEST = 8, 1e-3 * NEAR_PLANE, 1e12
# More than a path from the coarsest level to the finest leaves undone on its way.
_STACK_SIZE = 128


class Cut:
    """The boxes of a map's chunks, and the levels that they are of.

    Args:
        prepared: the map.
        max_chunks: that a view is drawn from, however large it is, of a map with coarser levels.
    """

    def __init__(self, prepared: PreparedMap, max_chunks: int = MAX_CHUNKS) -> None:
        self._max_chunks = max_chunks
        self._low, self._high, self._sizes = prepared.low, prepared.high, prepared.sizes
        self._starts = prepared.level_starts

    def chunks(self, view: CameraView) -> np.ndarray:
        """Return the indices (n,) int64 of the chunks that `view` is drawn from, in the order of the leaves.

        Of a map of one level they are those that it may see. Of others, a chunk takes the place of the leaves that it
        stands for where its Gaussians are seen no larger than MAX_SIZE pixels, the nearest of them as well. Where those
        are too many chunks, this holds up to some depth only, and behind it for what is (depth / that)^2 as large.
        """
        if len(self._starts) == 2:
            return visible_chunks(view, self._low, self._high)
        sides = frustum(view)
        most = min(self._max_chunks, int(_CHUNKS * math.sqrt(view.width * view.height / _PIXELS)))

        def cut(scale: float, reach: float) -> np.ndarray:
            boxes = (self._low, self._high, self._sizes, self._starts)
            return _cut(*boxes, view.origin, view.forward, scale, reach, *sides, most)

        scale = float(max(view.fx, view.fy)) / MAX_SIZE
        chunks = cut(scale, math.inf)
        if len(chunks) <= most:
            return chunks
        # Of the whole map; it may be infinite.
        size = float(np.abs(np.stack([self._low[-1], self._high[-1]]) - view.origin).sum())
        near, far = math.log(_LEAST), math.log(max(min(_FARTHEST, size), _LEAST))
        for _ in range(_HALVINGS):
            reach = 0.5 * (near + far)
            fewer = cut(scale, math.exp(reach))
            if len(fewer) <= most:
                chunks, near = fewer, reach
            else:
                far = reach
        # At last any size will do: a merged Gaussian may be infinite.
        return chunks if len(chunks) <= most else cut(0.0, math.inf)


@njit(nogil=True, cache=True)
def _cut(low, high, sizes, starts, origin, forward, scale, reach, inward, margins, limits, max_chunks):
    """Return the chunks, or more than `max_chunks` of them.

    `scale` is the focal length in the largest size allowed, `reach` the depth from which on larger ones are.
    """
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
        if level == 0 or scale == 0.0 or scale * sizes[chunk] <= depth * max(depth / reach, 1.0) ** 2:
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
