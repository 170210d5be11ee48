"""How far away is what is seen, by how it moves in the picture when the camera moves aside.

Behind a haze of splats, or among floaters, the depth of a pixel is theirs as often as not. What is tracked is texture:
that of the wall behind. So is the way that it moves.
"""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.pose.lift import MAX_DEPTH_STD, Lifted, lift_to, on_host
from gsfeatloc_ros.render.base import Render

# How far, in pixels, what is at the median depth is made to move: far against what tracking is off by, and not so far
# that it looks different.
_SHIFT = 12.0
# What has moved less far, or this far up or down, was not found.
_MIN_SHIFT, _MAX_SLIP = 1.5, 0.7
# What is tracked into two renders is off by this, in pixels, between them.
_SHIFT_SIGMA = 0.25


def step_aside(render: Render, camera: Camera, pixels: np.ndarray, max_scatter: float) -> float:
    """Return how far, in map units, to move a camera to its right to see by parallax how far away its pixels are.

    0 where the depths of a render under pixels (N, 2) can be trusted: half of them spread by at most `max_scatter` of
    the depth.
    """
    columns, rows = np.rint(pixels).astype(int).T
    median_depth, depth_std, _, places = on_host(render, rows * camera.width + columns)
    places = places[np.isfinite(median_depth[places])]
    depths, spreads = median_depth[places], depth_std[places]
    if len(places) == 0 or np.median(spreads / depths) <= max_scatter:
        return 0.0
    return _SHIFT * float(np.median(depths)) / camera.K[0, 0]


def lift_by_parallax(
    camera: Camera, T_map_camera: np.ndarray, pixels: np.ndarray, pixels_aside: np.ndarray, step: float
) -> Lifted:
    """Lift pixels (M, 2) of a pinhole camera at `T_map_camera` (4, 4).

    They were found at `pixels_aside` (M, 2) from where it is a `step` farther to its right, in map units. What did not
    move to the left, along its row, is not valid.
    """
    shift, slip = (pixels - pixels_aside).T
    valid = (shift >= _MIN_SHIFT) & (np.abs(slip) <= _MAX_SLIP)
    shift = np.where(valid, shift, np.nan)
    depths = camera.K[0, 0] * step / shift
    return lift_to(camera, T_map_camera, pixels, depths, depths * _SHIFT_SIGMA / shift)


def lift_as_nearest(
    camera: Camera, T_map_camera: np.ndarray, pixels: np.ndarray, known_pixels: np.ndarray, known: Lifted
) -> Lifted:
    """Lift pixels (M, 2), each as far as the nearest of `known_pixels` (N, 2) that was lifted; none if none was."""
    known_pixels, points = known_pixels[known.valid], known.points[known.valid]
    depths = np.full(len(pixels), np.nan)
    if len(points) > 0:
        nearest = ((pixels[:, None] - known_pixels) ** 2).sum(axis=2).argmin(axis=1)
        depths = ((points - T_map_camera[:3, 3]) @ T_map_camera[:3, 2])[nearest]
    return lift_to(camera, T_map_camera, pixels, depths, MAX_DEPTH_STD * depths)
