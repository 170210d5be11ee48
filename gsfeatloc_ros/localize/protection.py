"""How far an answer may be off: a bound that is exceeded once in 1,000 answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Share of the answers whose error exceeds the level.
RISK = 1e-3
# Standard deviations along the worst axis. Of a Gaussian error of three coordinates that are all alike, one in 1,000 is
# beyond 4.03; errors of real maps have longer tails. Fitted on real photos: docs/trust.md.
_DEVIATIONS = 6.0


@dataclass(frozen=True)
class ProtectionLevel:
    """Bounds of an answer's error, each exceeded by at most RISK of the answers.

    Attributes:
        radius: distance between the answer and the truth, map units.
        angle: between their orientations, radians.
    """

    radius: float
    angle: float


def protection_level(covariance: np.ndarray) -> ProtectionLevel:
    """Return the protection level of a pose with a covariance (6, 6) in ROS order (x y z, rotation about x y z)."""
    variances = [np.linalg.eigvalsh(block)[-1] for block in (covariance[:3, :3], covariance[3:, 3:])]
    radius, angle = _DEVIATIONS * np.sqrt(np.maximum(variances, 0.0))
    return ProtectionLevel(float(radius), float(min(angle, np.pi)))
