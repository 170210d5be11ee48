"""What each piece of the localizer brings: it is taken out, and the rest is measured.

Passes and the view search are options (`--set max_passes=1`, `--set max_views=0`); the pieces here are none, as nobody
would do without them on a robot.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import ModuleType

import numpy as np

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.match.base import Features, Matcher, Matches
from gsfeatloc_ros.pose import lift, solve
from gsfeatloc_ros.render.base import Render, Renderer

PIECES = ("sub-pixel", "median-depth", "depth-gating", "robust-loss")

# Values of a module's limits with which it does nothing.
_LIMITS: dict[str, tuple[ModuleType, dict[str, float]]] = {
    "depth-gating": (lift, {"MIN_ALPHA": 0.0, "MAX_DEPTH_STEP": np.inf}),
    "robust-loss": (solve, {"CAUCHY_SCALE": 1e3}),
}


@contextmanager
def without(piece: str) -> Iterator[None]:
    """While this is open, lifting and solving do without `piece`, if it is one of theirs."""
    if piece not in _LIMITS:
        yield
        return
    module, limits = _LIMITS[piece]
    before = {name: getattr(module, name) for name in limits}
    try:
        for name, value in limits.items():
            setattr(module, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(module, name, value)


class WholePixelMatcher:
    """A matcher whose pixels are rounded: without "sub-pixel"."""

    def __init__(self, matcher: Matcher) -> None:
        self._matcher = matcher

    def features(self, image: np.ndarray) -> Features:
        """The features of an RGB image (H, W, 3) uint8."""
        return self._matcher.features(image)

    def match(self, a: Features, b: Features) -> Matches:
        """Match the features of two images."""
        matches = self._matcher.match(a, b)
        return replace(matches, a=np.round(matches.a), b=np.round(matches.b))


class MeanDepthRenderer:
    """A renderer that gives the expected depth for the median: without "median-depth"."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer

    def render(self, camera: Camera, T_map_camera: np.ndarray) -> Render:
        """Render the map."""
        render = self._renderer.render(camera, T_map_camera)
        return replace(render, median_depth=render.depth)
