"""Renderers of 3D Gaussian Splatting maps: colour, depth, spread of the depth and coverage."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gsfeatloc_ros.common.device import DEVICES, chosen_device
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.render.base import Render, Renderer

if TYPE_CHECKING:
    from gsfeatloc_ros.render.prepare import PreparedMap

__all__ = ["DEVICES", "Render", "Renderer", "chosen_device", "create_renderer"]


def create_renderer(
    gaussian_map: GaussianMap | PreparedMap,
    device: str = "auto",
    threads: int = 0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sh_degree: int = 3,
    resolution_scale: float = 1.0,
) -> Renderer:
    """Make the renderer of a map.

    Args:
        gaussian_map: the map to draw, as it was read or prepared (render/prepare.py). It need not be kept.
        device: "cpu", "cuda" (needs the extra `gpu`), or "auto" for the best that works on this machine; if that is the
            CPU, the log says why.
        threads: CPU threads to use; 0 for one per core. They are of no use to a GPU.
        background: RGB in [0, 1] behind the map.
        sh_degree: degree of the spherical harmonics that are drawn, 0 to 3; those of the map beyond are left out.
        resolution_scale: draw pictures of so many times the width and height, 0.1 to 1, and enlarge them.

    Raises:
        ValueError: an unknown device, or a number out of its range.
        RuntimeError: device "cuda" cannot be used; the message says what is missing and what to do.
    """
    # Imported here: numba and torch take a second each, and users of the protocol alone do not need them.
    if chosen_device(device) == "cpu":
        from gsfeatloc_ros.render.cpu import CpuRenderer

        return CpuRenderer(gaussian_map, threads, background, sh_degree, resolution_scale)
    from gsfeatloc_ros.render.gpu import GpuRenderer

    return GpuRenderer(gaussian_map, background, sh_degree, resolution_scale)
