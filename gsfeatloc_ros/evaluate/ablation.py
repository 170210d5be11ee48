"""Ablation: the localizer without one of its parts, to measure what the part brings.

Passes and the view search are options (`--set max_passes=1`, `--set max_views=0`); the parts here are none, as nobody
would do without them on a robot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from gsfeatloc_ros.common.arrays import Array
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.query import Components
from gsfeatloc_ros.match import Matcher, Matches, Tracker, create_tracker
from gsfeatloc_ros.match.base import Worth, all_of_them
from gsfeatloc_ros.pose.lift import LiftOptions
from gsfeatloc_ros.render.base import Render, Renderer

ABLATIONS = ("tracking", "sub-pixel", "median-depth", "depth-gating", "parallax", "robust-loss")

# Lifts every pixel that has a depth.
_NO_DEPTH_GATING = LiftOptions(min_alpha=0.0, max_depth_step=float("inf"))
# So wide, in standard deviations, that Cauchy's loss is least squares.
_NO_ROBUST_LOSS_SCALE = 1e3


def ablated_localizer(components: Components, ablation: str = "") -> Localizer:
    """Make a localizer without one of ABLATIONS; "" for the whole one.

    Raises:
        ValueError: an unknown ablation.
    """
    renderer, matcher, options = components.renderer, components.matcher, components.options
    create_tracker: Callable[[Photo, str], Tracker] = components.create_tracker
    if ablation == "tracking":
        create_tracker = partial(FeatureTracker, matcher)
    elif ablation == "sub-pixel":
        create_tracker = WholePixelTracker
    elif ablation == "median-depth":
        renderer = MeanDepthRenderer(renderer)
    elif ablation == "depth-gating":
        options = replace(options, lift=_NO_DEPTH_GATING)
    elif ablation == "parallax":
        options = replace(options, lift=replace(options.lift, max_scatter=float("inf")))
    elif ablation == "robust-loss":
        options = replace(options, pose=replace(options.pose, cauchy_scale=_NO_ROBUST_LOSS_SCALE))
    elif ablation:
        raise ValueError(f"ablation {ablation!r} is not one of {', '.join(ABLATIONS)}")
    return Localizer(renderer, matcher, options, index=components.index, create_tracker=create_tracker)


class FeatureTracker:
    """Match features at full size in place of tracking corners."""

    def __init__(self, matcher: Matcher, photo: Photo, device: str) -> None:
        self._matcher = matcher
        self._features = matcher.features(photo.image)
        # Dense features have no pixels of their own.
        self.corners = create_tracker(photo, device).corners

    def track(self, image: Array, worth: Worth = all_of_them) -> Matches:
        """Find the photo's features in a render (H, W, 3) uint8 RGB."""
        return self._matcher.match(self._features, self._matcher.features(image))

    def track_back(self, image: Array, worth: Worth = all_of_them) -> Matches:
        """Find the features of a render in the photo."""
        return self._matcher.match(self._matcher.features(image), self._features).swapped()


class WholePixelTracker:
    """Track corners and round where they are in the render to whole pixels."""

    def __init__(self, photo: Photo, device: str) -> None:
        self._tracker = create_tracker(photo, device)
        self.corners = self._tracker.corners

    def track(self, image: Array, worth: Worth = all_of_them) -> Matches:
        """Find the photo's corners in a render (H, W, 3) uint8 RGB."""
        matches = self._tracker.track(image, worth)
        return replace(matches, b=np.round(matches.b))

    def track_back(self, image: Array, worth: Worth = all_of_them) -> Matches:
        """Find the corners of a render in the photo, in whole pixels of the render."""
        matches = self._tracker.track_back(image, worth)
        return replace(matches, b=np.round(matches.b))


class MeanDepthRenderer:
    """Render with the expected depth in place of the median."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self.device, self.solid_points, self.reading = renderer.device, renderer.solid_points, renderer.reading

    def render(self, camera: Camera, T_map_camera: np.ndarray) -> Render:
        """Render the map from the pose `T_map_camera` (4, 4)."""
        render = self._renderer.render(camera, T_map_camera)
        return replace(render, median_depth=render.depth)
