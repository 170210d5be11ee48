"""How well views of a map serve a localizer: what it could lift, and what it could match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.index.placement import VIEW
from gsfeatloc_ros.inspect.looks import Look
from gsfeatloc_ros.match import DEFAULT_MAX_FEATURES, create_matcher
from gsfeatloc_ros.pose.lift import LiftOptions, lift
from gsfeatloc_ros.render.base import DEPTH_MIN_ALPHA, Renderer

# Pixels so far apart, across and down, are lifted.
_GRID = 8
# Covered less than this, a pixel shows the background.
_BACKGROUND = 0.02


@dataclass(frozen=True)
class Quality:
    """Medians over views.

    Attributes:
        views: their number.
        corners: SIFT features a view of 320 x 240 pixels.
        lifted: share of the pixels that show something whose depth a localizer would trust (pose/lift.py).
        thin: share of these that are covered less than a half.
    """

    views: int
    corners: float
    lifted: float
    thin: float


def look_closely(renderer: Renderer, looks: Sequence[Look]) -> tuple[Quality, list[np.ndarray]]:
    """Draw the views of looks large; return how good they are, and the pictures (240, 320, 3) uint8 RGB."""
    matcher = create_matcher("sift", "", DEFAULT_MAX_FEATURES)
    columns, rows = np.meshgrid(np.arange(_GRID, VIEW.width, _GRID), np.arange(_GRID, VIEW.height, _GRID))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    found, pictures = [], []
    for look in looks:
        render = renderer.render(VIEW, look.pose).on_host()
        pictures.append(render.image())
        valid = lift(render, VIEW, look.pose, pixels, LiftOptions()).valid
        alpha = render.alpha[rows.ravel(), columns.ravel()]
        shown = alpha > _BACKGROUND
        shares = (valid[shown].mean(), (alpha[shown] < DEPTH_MIN_ALPHA).mean()) if shown.any() else (0.0, 1.0)
        found.append((len(matcher.features(pictures[-1])), *shares))
    corners, lifted, thin = np.median(np.reshape(found, (-1, 3)), axis=0).tolist() if found else (0.0, 0.0, 1.0)
    return Quality(len(looks), corners, lifted, thin), pictures
