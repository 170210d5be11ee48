"""Gaussians that hang in free space: in pictures from many places they are before something else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.index.placement import SMALL_VIEW
from gsfeatloc_ros.inspect.looks import Look
from gsfeatloc_ros.localize.settings import RendererSettings
from gsfeatloc_ros.maps import GaussianMap
from gsfeatloc_ros.render import create_renderer

# So many looks and Gaussians tell the share of floaters; of more a sample is taken.
_MAX_LOOKS = 120
_MAX_GAUSSIANS = 150_000
# Fainter Gaussians cannot be seen to hang anywhere.
_MIN_OPACITY = 0.05
# One hangs in front of what is behind it if it is nearer than this share of the median depth of the pixels around it: a
# floater covers few of them, a surface half. It is seen at all if it is not farther than that share of the depth.
_WINDOW = 5
_IN_FRONT = 0.85
_SEEN = 1.1
# It is a floater if it hangs so in this share of the looks that see it, and these are enough.
_MIN_FREE = 0.6
_MIN_LOOKS = 3
# Where there is no surface, what is seen is farther than everything else.
_NOTHING = 1e6
_NEAR = 1e-3


@dataclass(frozen=True)
class Floaters:
    """Gaussians in free space.

    Attributes:
        count: of the whole map; estimated where only a sample was looked at.
        share: of all Gaussians.
        low, median, high: percentiles 5, 50 and 95 of where they are, map frame; empty where there is none.
    """

    count: int
    share: float
    low: list[float]
    median: list[float]
    high: list[float]


def find_floaters(map_: GaussianMap, looks: Sequence[Look], settings: RendererSettings) -> Floaters:
    """Count the floaters of a map that looks see.

    They are drawn anew, antialiased: in pictures so small all that is smaller than a pixel would be as large as one.
    """
    renderer = create_renderer(replace(map_, antialiased=True), settings.device, settings.threads)
    drawn = [
        replace(look, render=renderer.render(SMALL_VIEW, look.pose).on_host())
        for look in looks[:: max(1, len(looks) // _MAX_LOOKS)]
    ]
    step = -(-len(map_) // _MAX_GAUSSIANS)
    sample = np.flatnonzero(map_.opacities[::step] >= _MIN_OPACITY) * step
    means = map_.S_map_splat.transform(map_.means[sample].astype(np.float64))
    places = means[floating(means, drawn)]
    count = len(places) * step
    low, median, high = np.percentile(places, [5, 50, 95], axis=0).tolist() if len(places) else ([], [], [])
    return Floaters(count, count / len(map_), low, median, high)


def floating(points: np.ndarray, looks: Sequence[Look]) -> np.ndarray:
    """Return whether points (N, 3) of the map frame hang in free space: (N,) bool."""
    size = [SMALL_VIEW.width, SMALL_VIEW.height]
    seen, free = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for look in looks:
        depth = np.nan_to_num(to_host(look.render.median_depth), nan=_NOTHING)
        behind = cv2.medianBlur(depth, _WINDOW)
        local = (points - look.pose[:3, 3]) @ look.pose[:3, :3]
        z = local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = np.rint(SMALL_VIEW.project(local))
            ahead = (z > _NEAR) & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)
        column, row = pixels[ahead].astype(np.intp).T
        seen[ahead] += z[ahead] < _SEEN * np.maximum(depth, behind)[row, column]
        free[ahead] += z[ahead] < _IN_FRONT * behind[row, column]
    return (seen >= _MIN_LOOKS) & (free >= _MIN_FREE * seen)
