"""What every renderer takes and returns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gsfeatloc_ros.common.arrays import Array, to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps.gaussian_map import GaussianMap

# Conventions of gsplat and of the INRIA rasterizer: a Gaussian is blurred by 0.3 square pixels, contributes where its
# alpha is at least 1/255, its alpha is cut at 0.999, and a ray ends before its transmittance falls to 1e-4.
EPS2D = 0.3
MIN_ALPHA = 1.0 / 255.0
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4
# Gaussians nearer than this (splat units) are not drawn, as in gsplat.
NEAR_PLANE = 0.01
# Depth is given where the splats cover at least this much of the pixel.
DEPTH_MIN_ALPHA = 0.5


@dataclass(frozen=True, eq=False)
class Render:
    """What a camera at one pose would see of the map: pictures, on the device of the renderer that drew them.

    Attributes:
        rgb: (H, W, 3) float32 in [0, 1], on the renderer's background.
        depth: (H, W) float32, alpha-weighted mean z-depth in map units; NaN where alpha < DEPTH_MIN_ALPHA.
        median_depth: (H, W) float32, z-depth in map units of the Gaussian at which the transmittance falls to a half;
            floaters that cover less than that do not move it, as they do the mean; NaN where depth is.
        depth_std: (H, W) float32, spread of the depths that made the pixel, in map units; NaN where depth is.
        alpha: (H, W) float32 in [0, 1], how much of the pixel the splats cover.
    """

    rgb: Array
    depth: Array
    median_depth: Array
    depth_std: Array
    alpha: Array

    def device_image(self) -> Array:
        """Colours as an 8-bit RGB image (H, W, 3), where they were drawn."""
        levels = (self.rgb * 255.0).round()
        return levels.astype(np.uint8) if isinstance(levels, np.ndarray) else levels.byte()

    def image(self) -> np.ndarray:
        """The same on the host."""
        return to_host(self.device_image())

    def on_host(self) -> Render:
        """All pictures as numpy's arrays."""
        pictures = (self.rgb, self.depth, self.median_depth, self.depth_std, self.alpha)
        return Render(*(to_host(picture) for picture in pictures))


class Renderer(Protocol):
    """Draws a map. Implementations are safe to call from any thread and release the GIL.

    Attributes:
        device: where renders lie: "cpu" for arrays of numpy's, or the device of torch's tensors.
    """

    device: str

    def render(self, camera: Camera, T_map_camera: np.ndarray) -> Render:
        """Draw what `camera` (its distortion ignored) sees from the pose `T_map_camera` (4, 4)."""
        ...


class SplatRenderer(ABC):
    """A renderer that draws in the splat frame: the camera is moved there, and depths come back in map units."""

    def __init__(self, gaussian_map: GaussianMap, device: str = "cpu") -> None:
        self.device = device
        self._map_scale = gaussian_map.S_map_splat.scale
        self._S_splat_map = gaussian_map.S_map_splat.inverse()

    def render(self, camera: Camera, T_map_camera: np.ndarray) -> Render:
        """Draw what `camera` (its distortion ignored) sees from the pose `T_map_camera` (4, 4)."""
        render = self._render(camera, self._S_splat_map.transform_pose(T_map_camera))
        if self._map_scale != 1.0:
            for depth in (render.depth, render.median_depth, render.depth_std):
                depth *= self._map_scale
        return render

    @abstractmethod
    def _render(self, camera: Camera, T_splat_camera: np.ndarray) -> Render:
        """Draw what `camera` sees from `T_splat_camera` (4, 4), with depths in splat units, in arrays of its own."""


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise ValueError where a renderer's parameter is not from `low` to `high`."""
    if not low <= value <= high:
        raise ValueError(f"renderer {name} is {value}; it must be from {low} to {high}")
