"""The renderer for robots without a GPU: numba kernels over persistent buffers."""

from __future__ import annotations

import os
import threading

import numba
import numpy as np

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.render import cpu_kernels as kernels
from gsfeatloc_ros.render.base import MIN_ALPHA, Render, SplatRenderer

# One frame at a time in the process: numba's fallback threading layer does not take parallel calls.
_LOCK = threading.Lock()


class CpuRenderer(SplatRenderer):
    """Tile-based rasterizer, with gsplat's conventions (render/base.py).

    Three parallel steps: project the Gaussians and list the tiles that each touches; gather the lists by tile; sort
    each by depth and blend it front to back.
    """

    def __init__(
        self, gaussian_map: GaussianMap, threads: int = 0, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        super().__init__(gaussian_map)
        self._threads = min(threads or _available_cores(), numba.config.NUMBA_NUM_THREADS)
        self._background = np.asarray(background, dtype=np.float32)
        seen = gaussian_map.opacities >= MIN_ALPHA
        self._means = np.ascontiguousarray(gaussian_map.means[seen])
        self._opacities = np.ascontiguousarray(gaussian_map.opacities[seen])
        self._antialiased = gaussian_map.antialiased
        self._sh = np.ascontiguousarray(gaussian_map.sh[seen])
        self._covariances = kernels.covariances(gaussian_map.scales[seen], gaussian_map.rotations[seen])
        self._splats = np.empty((len(self._means), kernels.SPLAT_SIZE), dtype=np.float32)
        self._pairs = _PairBuffers(self._threads, capacity=1 << 16)

    def _render(self, camera: Camera, T_splat_camera: np.ndarray) -> Render:
        pose = np.ascontiguousarray(T_splat_camera, dtype=np.float64)
        with _LOCK:
            numba.set_num_threads(self._threads)
            return self._draw(camera, pose)

    def _draw(self, camera: Camera, pose: np.ndarray) -> Render:
        tiles_x, tiles_y = -(-camera.width // kernels.TILE), -(-camera.height // kernels.TILE)
        histogram = np.empty((self._threads, tiles_x * tiles_y), dtype=np.int64)
        while True:
            needed = kernels.project(
                self._means,
                self._covariances,
                self._opacities,
                self._sh,
                self._antialiased,
                pose,
                camera.K,
                camera.width,
                camera.height,
                self._splats,
                self._pairs.tiles,
                self._pairs.splats,
                histogram,
            )
            if needed.max(initial=0) <= self._pairs.capacity:
                break
            self._pairs = _PairBuffers(self._threads, capacity=int(1.25 * needed.max()))
        starts = kernels.tile_starts(histogram)
        by_tile = self._pairs.by_tile[: starts[-1]]
        kernels.gather(self._pairs.tiles, self._pairs.splats, needed, histogram, by_tile)

        shape = (camera.height, camera.width)
        rgb = np.empty((*shape, 3), dtype=np.float32)
        images = [np.empty(shape, dtype=np.float32) for _ in range(4)]
        kernels.blend(self._splats, by_tile, starts, self._threads, self._background, rgb, *images)
        return Render(rgb, *images)


class _PairBuffers:
    """Lists of (tile, splat) pairs: a segment for each thread, and the same gathered by tile."""

    def __init__(self, threads: int, capacity: int) -> None:
        self.capacity = capacity
        self.tiles = np.empty((threads, capacity), dtype=np.int32)
        self.splats = np.empty((threads, capacity), dtype=np.int32)
        self.by_tile = np.empty(threads * capacity, dtype=np.int32)


def _available_cores() -> int:
    """Cores this process may use, which in a container may be fewer than the machine has."""
    return len(os.sched_getaffinity(0))
