"""What residuals near each other have in common: errors that do not average out over the matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# What matches so far from each other, in pixels, have in common is a field that is smooth over the photo. Those that
# are nearer are neighbours: they share the blur, the splat, the edge.
_NEIGHBOUR_DISTANCE, _FIELD_DISTANCE = 25.0, 60.0
MIN_PIXEL_SIGMA = 0.1
"""Keypoints are no better than this, in pixels, however well a few of them happen to agree."""
# Squares of this many pixels across: what map and camera are off by is taken to be the same all over one, and nothing
# to the next. The errors of photos, of crops and of what is left of covered ones are as large as follows from that.
_PATCH = 80.0
# All pairs of at most so many matches are looked at.
_MAX_PAIRED = 400
# A smooth field of this variance, in square pixels, is found in good maps too. What is beyond it the pose has as well.
_USUAL_FIELD = 0.01
# A field of this variance, that is this share of all variance, is found in bent maps alone (docs/trust.md).
_BENT_FIELD, _BENT_SHARE = 0.05, 0.25
# The pose absorbs most of such a field: its error is of the order of this variance in square pixels, reached where the
# field is twice the least of a bent map.
_BENT_VARIANCE = 30.0


@dataclass(frozen=True)
class ResidualField:
    """Variances along an axis, in square pixels, of residuals after pose and camera were fitted.

    Attributes:
        smooth: what matches have in common that are no neighbours. They are alike where the map is bent, or the camera
            is not as it is taken to be, in a way that no pose explains.
        total: of all.
        patches: how many patches of the photo the matches are spread over: as many as there would be if each had the
            same number of them (the inverse participation ratio).
    """

    smooth: float
    total: float
    patches: float

    @staticmethod
    def of(pixels: np.ndarray, residuals: np.ndarray, max_error: float) -> ResidualField:
        """Return the field of residuals (M, 2) at pixels (M, 2).

        Residuals longer than `max_error` pixels do not count: a cluster of wrong matches is no field.
        """
        from gsfeatloc_ros.pose.kernels import mean_product

        squared = (residuals**2).sum(axis=1)
        agrees = np.flatnonzero(squared <= max_error**2)
        patches = _effective_patches(pixels[agrees])
        agrees = agrees[:: 1 + len(agrees) // _MAX_PAIRED]
        total = 0.5 * float(squared[agrees].mean()) if len(agrees) else 0.0
        smooth = mean_product(pixels[agrees], residuals[agrees], _NEIGHBOUR_DISTANCE, _FIELD_DISTANCE)
        return ResidualField(smooth, total, patches)

    @property
    def bent_variance(self) -> float:
        """Variance, in square pixels along an axis, of what the pose is off by because the map is bent; 0 if it is not.

        How much of a bend the pose absorbs cannot be seen, only that what is left is too much.
        """
        excess = min(self.smooth / _BENT_FIELD, self.smooth / (_BENT_SHARE * self.total)) if self.total else 0.0
        return _BENT_VARIANCE * float(np.clip(excess - 1, 0, 1))

    def shared_variance(self, share: float) -> float:
        """Return the variance, in square pixels along an axis, of the error that all matches have in common.

        It is the variance of what each is off by, of which matches of one patch share this share and those of others
        nothing, and what the smooth field says beyond.
        """
        total = max(self.total, MIN_PIXEL_SIGMA**2)
        return share * total / self.patches + max(self.smooth - _USUAL_FIELD, 0.0) + self.bent_variance


def _effective_patches(pixels: np.ndarray) -> float:
    """Return the number of patches that pixels (M, 2) are spread over; 1 for none."""
    if len(pixels) == 0:
        return 1.0
    columns, rows = np.floor(pixels.T / _PATCH).astype(int)
    counts = np.bincount((rows - rows.min()) * (np.ptp(columns) + 1) + columns - columns.min())
    return float(len(pixels) ** 2 / (counts.astype(float) ** 2).sum())
