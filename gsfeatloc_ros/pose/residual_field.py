"""What residuals near each other have in common: errors that do not average out over the matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Matches nearer to each other than the first, in pixels, are neighbours: they share the blur, the splat, the edge.
# What those between the two have in common is a field that is smooth over the photo.
_NEIGHBOUR_DISTANCE, _FIELD_DISTANCE = 25.0, 60.0
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
        near: what neighbours have in common. The residuals of neighbours are alike where the photo is blurred or the
            map is locally off.
        smooth: what matches have in common that are farther apart. They are alike where the map is bent, or the camera
            is not as it is taken to be, in a way that no pose explains.
        total: of all.
    """

    near: float
    smooth: float
    total: float

    @staticmethod
    def of(pixels: np.ndarray, residuals: np.ndarray, max_error: float) -> ResidualField:
        """Return the field of residuals (M, 2) at pixels (M, 2).

        Residuals longer than `max_error` pixels count among neighbours alone: a cluster of wrong matches is no field.
        """
        from gsfeatloc_ros.pose.kernels import mean_products

        step = 1 + len(pixels) // _MAX_PAIRED
        pixels, residuals = pixels[::step], residuals[::step]
        agrees = (residuals**2).sum(axis=1) <= max_error**2
        total = 0.5 * float((residuals[agrees] ** 2).sum(axis=1).mean()) if agrees.any() else 0.0
        near, smooth = mean_products(pixels, residuals, agrees, _NEIGHBOUR_DISTANCE, _FIELD_DISTANCE)
        return ResidualField(near, smooth, total)

    @property
    def bent_variance(self) -> float:
        """Variance, in square pixels along an axis, of what the pose is off by because the map is bent; 0 if it is not.

        How much of a bend the pose absorbs cannot be seen, only that what is left is too much.
        """
        excess = min(self.smooth / _BENT_FIELD, self.smooth / (_BENT_SHARE * self.total)) if self.total else 0.0
        return _BENT_VARIANCE * float(np.clip(excess - 1, 0, 1))

    @property
    def shared_variance(self) -> float:
        """Variance, in square pixels along an axis, of what the pose is off by, by the smooth field in all."""
        return max(self.smooth - _USUAL_FIELD, 0.0) + self.bent_variance
