"""Haze in a map: large translucent balls before a camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import transform
from gsfeatloc_ros.maps import GaussianMap

_BALLS, _OPACITY = 30, 0.3
# In metres, and as standard deviations over the distance.
_DISTANCES, _SIZE = (0.4, 0.8), 0.25


def hazy(map_: GaussianMap, camera: Camera, T_map_camera: np.ndarray) -> GaussianMap:
    """Return a map in metres with haze before a pinhole camera at a pose (4, 4)."""
    rng = np.random.default_rng(0)
    pixels, distances = (
        rng.uniform([0, 0], [camera.width, camera.height], (_BALLS, 2)),
        rng.uniform(*_DISTANCES, _BALLS),
    )
    parts = {
        "means": transform(T_map_camera, camera.rays(pixels) * distances[:, None]),
        "scales": np.repeat(_SIZE * distances[:, None], 3, axis=1),
        "rotations": np.tile([1, 0, 0, 0], (_BALLS, 1)),
        "opacities": np.full(_BALLS, _OPACITY),
        "sh": np.zeros((_BALLS, *map_.sh.shape[1:])),
    }
    joined = {name: np.concatenate([getattr(map_, name), part.astype(np.float32)]) for name, part in parts.items()}
    return replace(map_, **joined)
