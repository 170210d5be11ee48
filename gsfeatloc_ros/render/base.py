"""What every renderer takes and returns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import Array, to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, Reading
from gsfeatloc_ros.maps.similarity import Similarity

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

# Solid Gaussians of a map of which a renderer knows where they are, for those who look for views of the map.
_SOLID_POINTS = 20_000

# Opens the block of a stage of a frame by its name, as StageClock.stage does.
Stage: TypeAlias = Callable[[str], AbstractContextManager[None]]


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise ValueError where a renderer's parameter is not from `low` to `high`."""
    if not low <= value <= high:
        raise ValueError(f"renderer {name} is {value}; it must be from {low} to {high}")


@dataclass(frozen=True)
class DrawOptions:
    """How a map is drawn.

    Attributes:
        background: RGB in [0, 1] behind the map.
        sh_degree: degree of the spherical harmonics that are drawn, 0 to 3; those of the map beyond are left out.
        resolution_scale: draw pictures of so many times the width and height, 0.1 to 1, and enlarge them.

    Raises:
        ValueError: a number out of its range.
    """

    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sh_degree: int = 3
    resolution_scale: float = 1.0

    def __post_init__(self) -> None:
        check_range("sh_degree", self.sh_degree, 0, len(SH_COEFFICIENTS) - 1)
        check_range("resolution_scale", self.resolution_scale, 0.1, 1.0)


DEFAULT_DRAW_OPTIONS = DrawOptions()


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
        """Return the colours as an 8-bit RGB image (H, W, 3), where they were drawn."""
        if isinstance(self.rgb, np.ndarray):
            return cv2.convertScaleAbs(self.rgb, alpha=255.0)
        return (self.rgb * 255.0).round().byte()

    def image(self) -> np.ndarray:
        """Return the colours as an 8-bit RGB image (H, W, 3), on the host."""
        return to_host(self.device_image())

    def on_host(self) -> Render:
        """Return the same with numpy arrays for all pictures."""
        return Render(
            to_host(self.rgb),
            to_host(self.depth),
            to_host(self.median_depth),
            to_host(self.depth_std),
            to_host(self.alpha),
        )


class StaleMapError(RuntimeError):
    """The file of a large map was changed while it was in use, or cannot be read: the map has to be loaded again."""


class Renderer(Protocol):
    """Draws a map. Implementations are safe to call from any thread and release the GIL.

    Attributes:
        device: where renders lie: "cpu" for numpy arrays, or the device of torch's tensors.
    """

    @property
    def device(self) -> str: ...

    @property
    def solid_points(self) -> np.ndarray:
        """Centres (n, 3) float64, map frame, of a sample of the Gaussians that are solid: what there is to see."""
        ...

    @property
    def reading(self) -> Reading:
        """What there is to say of how the map's file was read."""
        ...

    def render(self, camera: Camera, T_map_camera: np.ndarray) -> Render:
        """Draw what `camera` (its distortion ignored) sees from the pose `T_map_camera` (4, 4).

        Raises:
            StaleMapError: it cannot be read any more.
        """
        ...


class Placed(Protocol):
    """A map whose own frame lies somewhere in the robot's: a GaussianMap or a PreparedMap."""

    @property
    def S_map_splat(self) -> Similarity: ...

    @property
    def reading(self) -> Reading: ...

    def solid_points(self, count: int) -> np.ndarray:
        """Return the centres (n, 3), splat frame, of up to `count` solid Gaussians."""
        ...


def unmeasured(name: str) -> AbstractContextManager[None]:
    """Open the block of a stage whose time is not measured."""
    return _NO_MEASUREMENT


_NO_MEASUREMENT = nullcontext()


class SplatRenderer(ABC):
    """A renderer that draws in the splat frame: the camera is moved there, and depths come back in map units."""

    def __init__(self, placed_map: Placed, device: str = "cpu") -> None:
        self.device, self.reading = device, placed_map.reading
        self._map_scale = placed_map.S_map_splat.scale
        self._S_splat_map = placed_map.S_map_splat.inverse()
        self.solid_points = placed_map.S_map_splat.transform(placed_map.solid_points(_SOLID_POINTS))

    def render(self, camera: Camera, T_map_camera: np.ndarray, stage: Stage = unmeasured) -> Render:
        """Draw what `camera` (its distortion ignored) sees from the pose `T_map_camera` (4, 4).

        Args:
            camera: size and intrinsics.
            T_map_camera: (4, 4) pose.
            stage: opened for each stage of the frame, e.g. StageClock.stage. To measure a GPU, its clock waits for it.
        """
        render = self._render(camera, self._S_splat_map.transform_pose(T_map_camera), stage)
        if self._map_scale != 1.0:
            for depth in (render.depth, render.median_depth, render.depth_std):
                depth *= self._map_scale
        return render

    @abstractmethod
    def _render(self, camera: Camera, T_splat_camera: np.ndarray, stage: Stage) -> Render:
        """Draw what `camera` sees from `T_splat_camera` (4, 4), with depths in splat units, in arrays of its own."""
