"""Haze in a map: large translucent balls before a camera."""

from __future__ import annotations

import numpy as np
from small_maps import concatenated, one_gaussian

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import transform
from gsfeatloc_ros.maps import GaussianMap

_BALLS, _OPACITY, _GREY = 30, 0.3, (0.5, 0.5, 0.5)
# In metres, and as standard deviations over the distance.
_DISTANCES, _SIZE = (0.4, 0.8), 0.25


def hazy(map_: GaussianMap, camera: Camera, T_map_camera: np.ndarray) -> GaussianMap:
    """Return a map in metres, without harmonics, with haze before a pinhole camera at a pose (4, 4)."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [camera.width, camera.height], (_BALLS, 2))
    distances = rng.uniform(*_DISTANCES, _BALLS)
    means = transform(T_map_camera, camera.rays(pixels) * distances[:, None])
    balls = (
        one_gaussian(mean, _SIZE * distance, _OPACITY, _GREY) for mean, distance in zip(means, distances, strict=True)
    )
    return concatenated(map_, *balls)
