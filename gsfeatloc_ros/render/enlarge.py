"""From a picture drawn at a fraction of the size to one of the size asked for."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.render.base import Render


def draw_scaled(
    draw: Callable[[Camera, np.ndarray], Render], camera: Camera, T_splat_camera: np.ndarray, scale: float
) -> Render:
    """What `draw` draws for a camera of `scale` times the width and height, enlarged to those of `camera`."""
    if scale == 1.0:
        return draw(camera, T_splat_camera)
    size = (max(1, round(scale * pixels)) for pixels in (camera.width, camera.height))
    return enlarge(draw(camera.scaled(*size), T_splat_camera), camera.width, camera.height)


def enlarge(render: Render, width: int, height: int) -> Render:
    """A render resized to `width` x `height` pixels.

    Colours and coverage are interpolated. So are the mean and the mean square of the depth: where near meets far,
    `depth_std` says so, as it does where both are seen in one pixel. No depth where one of the neighbours has none.
    """
    render = render.on_host()
    # The mean square less the square of the mean would lose the spread to rounding in float32.
    depth = render.depth.astype(np.float64)
    mean = _interpolated(depth, width, height)
    mean_square = _interpolated(depth**2 + render.depth_std.astype(np.float64) ** 2, width, height)
    median = cv2.resize(render.median_depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return Render(
        rgb=_interpolated(render.rgb, width, height),
        depth=mean.astype(np.float32),
        median_depth=np.where(np.isnan(mean), np.float32(np.nan), median),
        depth_std=np.sqrt(np.maximum(mean_square - mean**2, 0.0)).astype(np.float32),
        alpha=_interpolated(render.alpha, width, height),
    )


def _interpolated(image: np.ndarray, width: int, height: int) -> np.ndarray:
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
