"""From matched pixels of a render to points of the map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from gsfeatloc_ros.common.arrays import to_device, to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import transform
from gsfeatloc_ros.render.base import Render

# The splats of a pixel lie scattered round the surface, and their median is closer to it than they are. A floater far
# in front of the surface spreads the depths without moving the median: the spread counts up to this share of the depth.
DEPTH_SIGMA_PER_STD = 0.3
MAX_DEPTH_STD = 0.1


@dataclass(frozen=True)
class LiftOptions:
    """Where a pixel is lifted: where its four neighbours are covered by splats and lie on one surface.

    Attributes:
        min_alpha: least coverage of each neighbour.
        max_depth_step: largest step of depth between them, relative to the depth: it tells a slope from an edge.
        max_depth_spread: largest spread of the depths that made the pixel, relative to the median. Of two layers, the
            spread is at most half of the farther one's depth: where it is more than half of the median, the median is
            that of a haze in front of what is seen.
        max_scatter: largest median of these spreads, over a render. Beyond it no depth is trusted, and how far away
            things are is seen by parallax (pose/parallax.py).
    """

    min_alpha: float = 0.8
    max_depth_step: float = 0.1
    max_depth_spread: float = 0.5
    max_scatter: float = 0.25


@dataclass(frozen=True, eq=False)
class Lifted:
    """Points of the map under pixels of a render.

    Attributes:
        points: (M, 3) float64, map frame; NaN where not valid.
        sigmas: (M, 3) float64, one standard deviation of each point along its ray, map frame; NaN where not valid.
        valid: (M,) bool, whether the depth could be trusted.
    """

    points: np.ndarray
    sigmas: np.ndarray
    valid: np.ndarray


# Finds the points of the map under pixels (M, 2) of a render.
Lift: TypeAlias = Callable[[np.ndarray], Lifted]


def lift(render: Render, camera: Camera, T_map_camera: np.ndarray, pixels: np.ndarray, options: LiftOptions) -> Lifted:
    """Lift pixels (M, 2) of `render`, drawn with `camera` at `T_map_camera` (4, 4), by bilinear median depth.

    The median, not the mean: semi-transparent floaters between the camera and the surface drag the mean along.
    Pixels outside the image, on edges of the depth or on thin splats are not valid.
    """
    # Not before the first: numba takes a second to load, and makes a folder.
    from gsfeatloc_ros.pose.kernels import bilinear_neighbours, surface_depths

    height, width = render.depth.shape
    pixels = np.ascontiguousarray(pixels, np.float64)
    places, weights = bilinear_neighbours(pixels, width, height)
    limits = options.min_alpha, options.max_depth_step, options.max_depth_spread
    depth, depth_std = surface_depths(*_on_host(render, places), weights, *limits)
    depth_std = np.minimum(depth_std, MAX_DEPTH_STD * depth)
    return lift_to(camera, T_map_camera, pixels, depth, DEPTH_SIGMA_PER_STD * depth_std)


def lift_to(
    camera: Camera, T_map_camera: np.ndarray, pixels: np.ndarray, depths: np.ndarray, sigmas: np.ndarray
) -> Lifted:
    """Lift pixels (M, 2) to z-depths (M,) with these standard deviations (M,); NaN: not valid."""
    rays = camera.rays(pixels)
    points = transform(T_map_camera, rays * depths[:, None])
    return Lifted(points, (rays * sigmas[:, None]) @ T_map_camera[:3, :3].T, np.isfinite(depths))


def _on_host(render: Render, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Median depth, its spread and alpha, flat, and where in them is what is at places (M, ...) of the render."""
    pictures = (render.median_depth, render.depth_std, render.alpha)
    if isinstance(render.alpha, np.ndarray):
        median_depth, depth_std, alpha = (to_host(picture).ravel() for picture in pictures)
        return median_depth, depth_std, alpha, places
    import torch

    # All that is wanted of the render, in one copy each way.
    there = to_device(places.ravel(), render.alpha.device)
    median_depth, depth_std, alpha = torch.stack([picture.flatten()[there] for picture in pictures]).cpu().numpy()
    return median_depth, depth_std, alpha, np.arange(places.size).reshape(places.shape)
