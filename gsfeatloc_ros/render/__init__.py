"""Renderers of 3D Gaussian Splatting maps: colour, depth, spread of the depth and coverage."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gsfeatloc_ros.common.device import DEVICES, choose_device, device_without
from gsfeatloc_ros.common.malloc import tune_malloc
from gsfeatloc_ros.common.threads import wait_passively
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.render.base import DEFAULT_DRAW_OPTIONS, DrawOptions, Render, Renderer, SplatRenderer, StaleMapError

if TYPE_CHECKING:
    from gsfeatloc_ros.render.chunks import PreparedMap

__all__ = ["DEVICES", "DrawOptions", "Render", "Renderer", "SplatRenderer", "StaleMapError", "create_renderer"]


def create_renderer(
    gaussian_map: GaussianMap | PreparedMap,
    device: str = "auto",
    threads: int = 0,
    options: DrawOptions = DEFAULT_DRAW_OPTIONS,
) -> SplatRenderer:
    """Make the renderer of a map.

    Args:
        gaussian_map: the map to draw, as it was read or prepared (render/prepare.py). It need not be kept.
        device: "cpu", "cuda" (needs the extra `gpu`), or "auto" for the best that works on this machine; if that is the
            CPU, the log says why.
        threads: CPU threads to use; 0 for one per core. They are of no use to a GPU.
        options: how it is drawn.

    Raises:
        ValueError: an unknown device, or a number out of its range.
        RuntimeError: device "cuda" cannot be used; the message says what is missing and what to do.
    """
    wait_passively()
    tune_malloc()
    # Imported here: numba and torch take a second each, and users of the protocol alone do not need them.
    if choose_device(device) == "cuda":
        from gsfeatloc_ros.render.gpu import GpuRenderer, self_check

        if device_without(self_check("cuda"), device) == "cuda":
            return GpuRenderer(gaussian_map, options)
    from gsfeatloc_ros.render.cpu import CpuRenderer

    return CpuRenderer(gaussian_map, threads, options)
