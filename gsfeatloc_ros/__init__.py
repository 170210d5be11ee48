"""Relocalization of a camera in a 3D Gaussian Splatting map, for ROS 2 and without."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsfeatloc_ros.common.camera import Camera
    from gsfeatloc_ros.evaluate.photo_file import read_photo
    from gsfeatloc_ros.localize.estimate import Estimate, Status
    from gsfeatloc_ros.localize.localizer import Localizer
    from gsfeatloc_ros.localize.options import LocalizerOptions
    from gsfeatloc_ros.maps import load_map
    from gsfeatloc_ros.match import create_matcher
    from gsfeatloc_ros.render import create_renderer

__all__ = [
    "Camera",
    "Estimate",
    "Localizer",
    "LocalizerOptions",
    "Status",
    "create_matcher",
    "create_renderer",
    "load_map",
    "read_photo",
]

# Where each name is. They are imported when first used: numba, torch and OpenCV take seconds.
_MODULES = {
    "Camera": "common.camera",
    "Estimate": "localize.estimate",
    "Localizer": "localize.localizer",
    "LocalizerOptions": "localize.options",
    "Status": "localize.estimate",
    "create_matcher": "match",
    "create_renderer": "render",
    "load_map": "maps",
    "read_photo": "evaluate.photo_file",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
