"""What each piece of the localizer brings: it is taken out, and the rest is measured.

Passes and the view search are options (`--set max_passes=1`, `--set max_views=0`); the pieces here are none, as nobody
would do without them on a robot.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from types import ModuleType

import numpy as np

from gsfeatloc_ros.common.arrays import Array
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.localize import localizer as localize
from gsfeatloc_ros.match import Matcher, Matches, create_tracker
from gsfeatloc_ros.pose import lift, solve
from gsfeatloc_ros.render.base import Render, Renderer

PIECES = ("tracking", "sub-pixel", "median-depth", "depth-gating", "robust-loss")

# Values of a module's limits with which it does nothing.
_NO_LIMITS: dict[str, tuple[ModuleType, dict[str, float]]] = {
    "depth-gating": (lift, {"MIN_ALPHA": 0.0, "MAX_DEPTH_STEP": np.inf}),
    "robust-loss": (solve, {"CAUCHY_SCALE": 1e3}),
}


@contextmanager
def without(piece: str, matcher: Matcher) -> Iterator[None]:
    """While this is open, localizers do without `piece`: one of PIECES, or "" for nothing.

    What takes the place of tracking is the matching of features at full size, by `matcher`.
    """
    module, values = _NO_LIMITS.get(piece, (localize, {}))
    if piece == "tracking":
        values = {"create_tracker": partial(FeatureTracker, matcher)}
    if piece == "sub-pixel":
        values = {"create_tracker": WholePixelTracker}
    before = {name: getattr(module, name) for name in values}
    try:
        for name, value in values.items():
            setattr(module, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(module, name, value)


class FeatureTracker:
    """Has the place of a tracker of corners, and matches features instead."""

    def __init__(self, matcher: Matcher, photo: Photo, device: str) -> None:
        self._matcher = matcher
        self.corners = matcher.features(photo.image)

    def track(self, image: Array) -> Matches:
        """Find the photo's features in a render."""
        return self._matcher.match(self.corners, self._matcher.features(image))


class WholePixelTracker:
    """Without "sub-pixel": where the corners are in the render is rounded."""

    def __init__(self, photo: Photo, device: str) -> None:
        self._tracker = create_tracker(photo, device)
        self.corners = self._tracker.corners

    def track(self, image: Array) -> Matches:
        """Find the photo's corners in a render."""
        matches = self._tracker.track(image)
        return replace(matches, b=np.round(matches.b))


class MeanDepthRenderer:
    """A renderer that gives the expected depth for the median: without "median-depth"."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self.device = renderer.device

    def render(self, camera: Camera, T_map_camera: np.ndarray) -> Render:
        """Render the map."""
        render = self._renderer.render(camera, T_map_camera)
        return replace(render, median_depth=render.depth)
