"""From a picture drawn at a fraction of the size to one of the size asked for, on the device where it was drawn."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import to_device, to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.render.base import Render

if TYPE_CHECKING:  # torch takes a second to import, which a robot without a GPU is spared
    import torch


def draw_scaled(
    draw: Callable[[Camera, np.ndarray], Render], camera: Camera, T_splat_camera: np.ndarray, scale: float
) -> Render:
    """Draw for a camera of `scale` times the width and height, and enlarge the picture to those of `camera`."""
    if scale == 1.0:
        return draw(camera, T_splat_camera)
    size = (max(1, round(scale * pixels)) for pixels in (camera.width, camera.height))
    return enlarge(draw(camera.scaled(*size), T_splat_camera), camera.width, camera.height)


def enlarge(render: Render, width: int, height: int) -> Render:
    """Return a render resized to `width` x `height` pixels, on its device.

    Colours and coverage are interpolated. So are the mean and the mean square of the depth: where near meets far,
    `depth_std` says so, as it does where both are seen in one pixel. No depth where one of the neighbours has none.
    """
    if isinstance(render.rgb, np.ndarray):
        return _enlarge_on_host(render, width, height)
    return _enlarge_on_device(render, width, height, render.rgb.device)


def _enlarge_on_host(render: Render, width: int, height: int) -> Render:
    # The mean square less the square of the mean would lose the spread to rounding in float32.
    depth, depth_std = (to_host(picture).astype(np.float64) for picture in (render.depth, render.depth_std))
    mean = _interpolated(depth, width, height)
    mean_square = _interpolated(depth**2 + depth_std**2, width, height)
    median = cv2.resize(to_host(render.median_depth), (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return Render(
        rgb=_interpolated(to_host(render.rgb), width, height),
        depth=mean.astype(np.float32),
        median_depth=np.where(np.isnan(mean), np.float32(np.nan), median),
        depth_std=np.sqrt(np.maximum(mean_square - mean**2, 0.0)).astype(np.float32),
        alpha=_interpolated(to_host(render.alpha), width, height),
    )


def _interpolated(image: np.ndarray, width: int, height: int) -> np.ndarray:
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)


def _enlarge_on_device(render: Render, width: int, height: int, device: torch.device) -> Render:
    """Do the same in torch, whose interpolation of this kind is OpenCV's."""
    import torch
    from torch.nn.functional import interpolate

    def interpolated(images: torch.Tensor) -> torch.Tensor:
        return interpolate(images[None], (height, width), mode="bilinear", align_corners=False)[0]

    rgb, depth, median, depth_std, alpha = (
        to_device(picture, device)
        for picture in (render.rgb, render.depth, render.median_depth, render.depth_std, render.alpha)
    )
    colors = interpolated(torch.cat([rgb.permute(2, 0, 1), alpha[None]]))
    depth, depth_std = depth.double(), depth_std.double()
    mean, mean_square = interpolated(torch.stack([depth, depth**2 + depth_std**2]))
    median = interpolate(median[None, None], (height, width), mode="nearest-exact")[0, 0]
    return Render(
        rgb=colors[:3].permute(1, 2, 0).contiguous(),
        depth=mean.float(),
        median_depth=median.masked_fill(mean.isnan(), torch.nan),
        depth_std=(mean_square - mean**2).clamp(min=0.0).sqrt().float(),
        alpha=colors[3],
    )
