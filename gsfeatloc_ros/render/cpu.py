"""The renderer for robots without a GPU: numba kernels over persistent buffers."""

from __future__ import annotations

import os

import numba
import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap
from gsfeatloc_ros.render.base import Render, SplatRenderer, check_range
from gsfeatloc_ros.render.blend import blend, gather, tile_starts
from gsfeatloc_ros.render.camera_view import view_of, visible_chunks
from gsfeatloc_ros.render.enlarge import draw_scaled
from gsfeatloc_ros.render.prepare import CHUNK, KERNEL_LOCK, PreparedMap, prepare
from gsfeatloc_ros.render.project import SPLAT_SIZE, TILE, project

_MAX_THREADS = 1024


class CpuRenderer(SplatRenderer):
    """Tile-based rasterizer, with gsplat's conventions (render/base.py).

    After chunks of Gaussians out of view are left out, three parallel steps: project the others and list the tiles
    that each touches; gather the lists by tile; sort each by depth and blend it front to back.
    """

    def __init__(
        self,
        gaussian_map: GaussianMap | PreparedMap,
        threads: int = 0,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        sh_degree: int = 3,
        resolution_scale: float = 1.0,
    ) -> None:
        """See `create_renderer`. A GaussianMap is not kept, only what is prepared from it.

        Raises:
            ValueError: a number out of its range.
        """
        check_range("threads", threads, 0, _MAX_THREADS)
        check_range("sh_degree", sh_degree, 0, len(SH_COEFFICIENTS) - 1)
        check_range("resolution_scale", resolution_scale, 0.1, 1.0)
        super().__init__(gaussian_map)
        prepared = gaussian_map if isinstance(gaussian_map, PreparedMap) else prepare(gaussian_map)
        self._threads = min(threads or _available_cores(), numba.config.NUMBA_NUM_THREADS)
        self._background = np.asarray(background, dtype=np.float32)
        self._resolution_scale = resolution_scale
        self._antialiased = prepared.antialiased
        self._low, self._high = prepared.low, prepared.high
        self._gaussians = prepared.gaussians.reshape(-1)
        self._sh = prepared.sh.view(np.int16).reshape(-1)
        stored = prepared.sh.shape[1] // 3
        self._harmonics = (stored, min(stored, SH_COEFFICIENTS[sh_degree]))
        self._splats = np.empty(0, dtype=np.float32)
        self._pairs = _PairBuffers(self._threads, capacity=1 << 16)

    def _render(self, camera: Camera, T_splat_camera: np.ndarray) -> Render:
        return draw_scaled(self._draw, camera, T_splat_camera, self._resolution_scale)

    def _draw(self, camera: Camera, T_splat_camera: np.ndarray) -> Render:
        with KERNEL_LOCK:
            numba.set_num_threads(self._threads)
            return self._draw_alone(camera, T_splat_camera)

    def _draw_alone(self, camera: Camera, T_splat_camera: np.ndarray) -> Render:
        view = view_of(camera, T_splat_camera)
        chunks = visible_chunks(view, self._low, self._high)
        if len(self._splats) < len(chunks) * CHUNK * SPLAT_SIZE:
            self._splats = np.empty(len(chunks) * CHUNK * SPLAT_SIZE, dtype=np.float32)
        tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
        histogram = np.empty((self._threads, tiles), dtype=np.int64)
        while True:
            pairs = project(
                chunks,
                self._gaussians,
                self._sh,
                self._harmonics,
                self._antialiased,
                view,
                self._splats,
                self._pairs.tiles,
                self._pairs.keys,
                histogram,
            )
            if pairs.max(initial=0) <= self._pairs.capacity:
                break
            self._pairs = _PairBuffers(self._threads, capacity=int(1.25 * pairs.max()))
        starts = tile_starts(histogram)
        by_tile = self._pairs.by_tile[: starts[-1]]
        gather(self._pairs.tiles, self._pairs.keys, pairs, histogram, by_tile)

        shape = (camera.height, camera.width)
        rgb = np.empty((*shape, 3), dtype=np.float32)
        images = [np.empty(shape, dtype=np.float32) for _ in range(4)]
        blend(self._splats, by_tile, starts, self._threads, self._background, rgb, *images)
        return Render(rgb, *images)


class _PairBuffers:
    """Lists of pairs of a tile and a splat's key: a segment for each thread, and the keys gathered by tile."""

    def __init__(self, threads: int, capacity: int) -> None:
        self.capacity = capacity
        self.tiles = np.empty((threads, capacity), dtype=np.int32)
        self.keys = np.empty((threads, capacity), dtype=np.uint64)
        self.by_tile = np.empty(threads * capacity, dtype=np.uint64)


def _available_cores() -> int:
    """Cores this process may use, which in a container may be fewer than the machine has."""
    return len(os.sched_getaffinity(0))
