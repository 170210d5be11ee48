"""From matched pixels of a render to points of the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.arrays import to_device
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
    """

    min_alpha: float = 0.8
    max_depth_step: float = 0.1
    max_depth_spread: float = 0.5


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


def lift(render: Render, camera: Camera, T_map_camera: np.ndarray, pixels: np.ndarray, options: LiftOptions) -> Lifted:
    """Lift pixels (M, 2) of `render`, drawn with `camera` at `T_map_camera` (4, 4), by bilinear median depth.

    The median, not the mean: semi-transparent floaters between the camera and the surface drag the mean along.
    Pixels outside the image, on edges of the depth or on thin splats are not valid.
    """
    height, width = render.depth.shape
    x, y = pixels[:, 0], pixels[:, 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    column = np.clip(np.floor(np.where(inside, x, 0)).astype(int), 0, max(width - 2, 0))
    row = np.clip(np.floor(np.where(inside, y, 0)).astype(int), 0, max(height - 2, 0))
    rows = row[:, None] + np.array([0, 0, 1, 1]) * (height > 1)
    columns = column[:, None] + np.array([0, 1, 0, 1]) * (width > 1)
    fx, fy = np.clip(x - column, 0, 1), np.clip(y - row, 0, 1)
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=1)

    depths, depth_stds, alphas = _sampled(render, rows, columns)  # (M, 4) each, NaN where there is none
    depth = (weights * depths).sum(axis=1)
    spread = (weights * depth_stds).sum(axis=1)
    depth_std = np.minimum(spread, MAX_DEPTH_STD * depth)
    # Comparisons with NaN are false: what has no depth is not valid.
    one_surface = depths.max(axis=1) - depths.min(axis=1) <= options.max_depth_step * depth
    seen_surface = spread <= options.max_depth_spread * depth
    valid = inside & (alphas.min(axis=1) >= options.min_alpha) & one_surface & seen_surface
    depth = np.where(valid, depth, np.nan)
    rays = camera.rays(pixels)
    points = transform(T_map_camera, rays * depth[:, None])
    sigmas = (rays * (DEPTH_SIGMA_PER_STD * depth_std)[:, None]) @ T_map_camera[:3, :3].T
    return Lifted(points, np.where(valid[:, None], sigmas, np.nan), valid)


def _sampled(render: Render, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Median depth, its spread and alpha at pixels: (3, ...) float64, all of the render that comes to the host."""
    pictures = (render.median_depth, render.depth_std, render.alpha)
    if isinstance(render.alpha, np.ndarray):
        return np.stack([picture[rows, columns] for picture in pictures]).astype(np.float64)
    import torch

    # In one copy each way.
    pixels = to_device(rows * render.alpha.shape[1] + columns, render.alpha.device)
    return torch.stack([picture.flatten()[pixels] for picture in pictures]).cpu().double().numpy()
