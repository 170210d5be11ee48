"""The point of the map that was clicked."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import transform
from gsfeatloc_ros.render import Renderer
from gsfeatloc_ros.view.shapes import looking_along

# A picture of 5 x 5 pixels, 0.3 degrees wide, of which the middle counts.
_NARROW = Camera.centred(5, 5, 955.0)


def point_on_map(renderer: Renderer, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
    """Return the point (3,) of the map that a ray from a point (3,) along a direction (3,) meets; None for none."""
    pose = looking_along(origin, direction)
    depth = float(to_host(renderer.render(_NARROW, pose).median_depth)[2, 2])
    return transform(pose, np.array([[0.0, 0.0, depth]]))[0] if np.isfinite(depth) else None
