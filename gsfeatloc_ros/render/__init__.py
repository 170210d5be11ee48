"""Renderers of 3D Gaussian Splatting maps: colour, depth, spread of the depth and coverage."""

from __future__ import annotations

from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.render.base import Render, Renderer

__all__ = ["DEVICES", "Render", "Renderer", "create_renderer"]

DEVICES = ("auto", "cpu")


def create_renderer(
    gaussian_map: GaussianMap,
    device: str = "auto",
    threads: int = 0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Renderer:
    """Make the renderer of a map.

    Args:
        gaussian_map: the map to draw.
        device: "cpu", or "auto" for the best that this machine has (at present the CPU).
        threads: CPU threads to use; 0 for one per core.
        background: RGB in [0, 1] behind the map.

    Raises:
        ValueError: an unknown device.
    """
    if device not in DEVICES:
        raise ValueError(f"renderer device {device!r} is not one of {', '.join(DEVICES)}")
    # Imported here: numba takes a second, and users of the protocol alone do not need it.
    from gsfeatloc_ros.render.cpu import CpuRenderer

    return CpuRenderer(gaussian_map, threads, background)
