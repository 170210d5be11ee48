"""The renderer for robots without a GPU: numba kernels over persistent buffers."""

from __future__ import annotations

import os
from functools import partial

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.kernels import max_threads, set_threads
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap
from gsfeatloc_ros.render.base import DEFAULT_DRAW_OPTIONS, DrawOptions, Render, SplatRenderer, Stage, check_range
from gsfeatloc_ros.render.blend import blend, gather, tile_starts
from gsfeatloc_ros.render.camera_view import camera_view
from gsfeatloc_ros.render.chunks import CHUNK, KERNEL_LOCK, PreparedMap
from gsfeatloc_ros.render.cut import Cut
from gsfeatloc_ros.render.enlarge import draw_scaled
from gsfeatloc_ros.render.prepare import prepare
from gsfeatloc_ros.render.project import SPLAT_SIZE, TILE, project
from gsfeatloc_ros.render.stored import Resident

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
        options: DrawOptions = DEFAULT_DRAW_OPTIONS,
    ) -> None:
        """Prepare a map, if it is not yet; see `create_renderer`. A GaussianMap is not kept.

        Raises:
            ValueError: a number of threads out of its range.
        """
        check_range("threads", threads, 0, _MAX_THREADS)
        super().__init__(gaussian_map)
        prepared = gaussian_map if isinstance(gaussian_map, PreparedMap) else prepare(gaussian_map)
        self._threads = min(threads or _available_cores(), max_threads())
        self._background = np.asarray(options.background, dtype=np.float32)
        self._resolution_scale = options.resolution_scale
        self._antialiased = prepared.antialiased
        self._cut = Cut(prepared)
        self._resident = Resident(prepared)
        self._gaussians = self._resident.gaussians.reshape(-1)
        self._sh = self._resident.sh.view(np.int16).reshape(-1)
        stored = prepared.sh_coefficients
        self._harmonics = (stored, min(stored, SH_COEFFICIENTS[options.sh_degree]))
        self._splats = np.empty(0, dtype=np.float32)
        self._pairs = _PairBuffers(self._threads, capacity=1 << 16)

    def _render(self, camera: Camera, T_splat_camera: np.ndarray, stage: Stage) -> Render:
        return draw_scaled(partial(self._draw, stage=stage), camera, T_splat_camera, self._resolution_scale)

    def _draw(self, camera: Camera, T_splat_camera: np.ndarray, stage: Stage) -> Render:
        with KERNEL_LOCK:
            set_threads(self._threads)
            return self._draw_alone(camera, T_splat_camera, stage)

    def _draw_alone(self, camera: Camera, T_splat_camera: np.ndarray, stage: Stage) -> Render:
        view = camera_view(camera, T_splat_camera)
        with stage("cull"):
            chunks = self._cut.chunks(view)
        with stage("read"):
            slots = self._resident.slots(chunks)
        if len(self._splats) < len(chunks) * CHUNK * SPLAT_SIZE:
            self._splats = np.empty(len(chunks) * CHUNK * SPLAT_SIZE, dtype=np.float32)
        tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
        histogram = np.empty((self._threads, tiles), dtype=np.int64)
        while True:
            with stage("project"):
                pairs = project(
                    slots,
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
        with stage("scatter"):
            starts = tile_starts(histogram)
            by_tile = self._pairs.by_tile[: starts[-1]]
            gather(self._pairs.tiles, self._pairs.keys, pairs, histogram, by_tile)

        shape = (camera.height, camera.width)
        rgb = np.empty((*shape, 3), dtype=np.float32)
        depth, median_depth, depth_std, alpha = (np.empty(shape, dtype=np.float32) for _ in range(4))
        with stage("sort and blend"):
            blend(
                self._splats,
                by_tile,
                starts,
                self._threads,
                self._background,
                rgb,
                depth,
                median_depth,
                depth_std,
                alpha,
            )
        return Render(rgb, depth, median_depth, depth_std, alpha)


class _PairBuffers:
    """Lists of pairs of a tile and a splat's key: a segment for each thread, and the keys gathered by tile."""

    def __init__(self, threads: int, capacity: int) -> None:
        self.capacity = capacity
        self.tiles = np.empty((threads, capacity), dtype=np.int32)
        self.keys = np.empty((threads, capacity), dtype=np.uint64)
        self.by_tile = np.empty(threads * capacity, dtype=np.uint64)


def _available_cores() -> int:
    """Return how many cores this process may use: in a container, perhaps fewer than the machine has."""
    return len(os.sched_getaffinity(0))
