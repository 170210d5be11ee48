"""Localizes the photos of a scene and measures the answers."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from gsfeatloc_ros.evaluate.metrics import QueryResult, measure
from gsfeatloc_ros.evaluate.protocol import trajectory_radius
from gsfeatloc_ros.evaluate.published import PublishedLocalizer
from gsfeatloc_ros.evaluate.scene import Scene
from gsfeatloc_ros.localize import Localizer, LocalizerOptions
from gsfeatloc_ros.match import Matcher
from gsfeatloc_ros.render import Renderer

METHODS = ("default", "published")


def create_localizer(
    method: str, renderer: Renderer, matcher: Matcher, max_image_width: int, seed: int
) -> Localizer | PublishedLocalizer:
    """Make the localizer of a method, "default" (this package's) or "published"."""
    if method == "published":
        return PublishedLocalizer(renderer, matcher, max_image_width)
    return Localizer(renderer, matcher, LocalizerOptions(max_image_width=max_image_width, seed=seed))


def localize_photos(
    scene: Scene, localizer: Localizer | PublishedLocalizer, priors: list[np.ndarray]
) -> Iterator[QueryResult]:
    """Localize the first `len(priors)` photos from their priors (4, 4), one result at a time.

    Only the localization is timed, not reading the photo; the first photo is localized once before, so that what is
    compiled or loaded at the first call does not count.
    """
    radius = trajectory_radius(scene)
    for index, (photo, prior) in enumerate(zip(scene.photos, priors, strict=False)):
        image = scene.read_photo(photo)
        if index == 0:
            localizer.localize(image, scene.camera, prior)
        start = time.perf_counter()
        estimate = localizer.localize(image, scene.camera, prior)
        milliseconds = 1000.0 * (time.perf_counter() - start)
        yield measure(
            photo.path.name,
            estimate,
            photo.T_map_camera,
            prior,
            radius,
            milliseconds,
            prior_is_answer=isinstance(localizer, PublishedLocalizer),
        )
