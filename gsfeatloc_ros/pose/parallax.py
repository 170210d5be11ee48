"""How far away is what is seen, by how it moves in the picture when the camera moves aside.

Behind a haze of splats, or among floaters, the depth of a pixel is theirs as often as not. What is followed from one
picture to the other is texture: that of the wall behind. So is the way that it moves.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose
from gsfeatloc_ros.pose.lift import Lift, Lifted, LiftOptions, lift, lift_to
from gsfeatloc_ros.render.base import Render, Renderer

# How far, in pixels, what is at the median depth is made to move: far against what following is off by, and not so far
# that it looks different.
_SHIFT = 12.0
# What has moved less far, or this far up or down, was not found.
_MIN_SHIFT, _MAX_SLIP = 1.5, 0.7
# What is followed is off by this, in pixels.
_SHIFT_SIGMA = 0.25
# The pixels that tell whether depths are scattered: one of eight across, and down.
_GRID = (slice(4, None, 8), slice(4, None, 8))


def lifting(renderer: Renderer, render: Render, camera: Camera, T_map_camera: np.ndarray, options: LiftOptions) -> Lift:
    """Return what lifts pixels (M, 2) of a render, drawn with a pinhole camera at `T_map_camera` (4, 4).

    By its depths (`lift`); where these are scattered by parallax, from another render, a step to the right.
    """
    step = step_aside(render, camera, options.max_scatter)
    if step == 0:
        return partial(lift, render, camera, T_map_camera, options=options)
    aside = renderer.render(camera, T_map_camera @ make_pose(np.eye(3), np.array([step, 0.0, 0.0])))
    # Not before the first: numba takes a second to load, and makes a folder.
    from gsfeatloc_ros.match.track import Follower

    follower = Follower(render.device_image(), aside.device_image())
    return lambda pixels: lift_by_parallax(camera, T_map_camera, pixels, follower.follow(pixels), step)


def step_aside(render: Render, camera: Camera, max_scatter: float) -> float:
    """Return how far, in map units, to move a camera to its right to see by parallax how far away its pixels are.

    0 where the depths of a render can be trusted: half of them spread by at most `max_scatter` of the depth.
    """
    depths = render.median_depth[_GRID]
    scatter = to_host(render.depth_std[_GRID] / depths)
    known = scatter[np.isfinite(scatter)]
    if known.size == 0 or np.median(known) <= max_scatter:
        return 0.0
    return _SHIFT * float(np.nanmedian(to_host(depths))) / camera.K[0, 0]


def lift_by_parallax(
    camera: Camera, T_map_camera: np.ndarray, pixels: np.ndarray, pixels_aside: np.ndarray, step: float
) -> Lifted:
    """Lift pixels (M, 2) of a pinhole camera at `T_map_camera` (4, 4).

    They were found at `pixels_aside` (M, 2; NaN: not) from where it is a `step` farther to its right, in map units.
    What did not move to the left, along its row, is not valid.
    """
    shift, slip = (pixels - pixels_aside).T
    valid = (shift >= _MIN_SHIFT) & (np.abs(slip) <= _MAX_SLIP)
    shift = np.where(valid, shift, np.nan)
    depths = camera.K[0, 0] * step / shift
    return lift_to(camera, T_map_camera, pixels, depths, depths * _SHIFT_SIGMA / shift)
