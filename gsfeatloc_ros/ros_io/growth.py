"""How uncertain a pose becomes while nothing confirms it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.parameter import parameter


@dataclass(frozen=True)
class GrowthOptions:
    """How fast a pose becomes uncertain: by the odometry's own errors, or by how fast the robot may move without it."""

    max_speed: float = parameter(
        1.0,
        "Map units a second by which a robot without odometry may have moved since its last answer.",
        (0.0, 1e4),
        live=True,
    )
    max_turn_rate: float = parameter(60.0, "The same of its turn, degrees a second.", (0.0, 1e4), live=True)
    odometry_distance_error: float = parameter(
        0.1, "Share of the way by which odometry may be off (standard deviation).", (0.0, 10.0), live=True
    )
    odometry_turn_error: float = parameter(
        0.1, "Share of the turn by which odometry may be off (standard deviation).", (0.0, 10.0), live=True
    )

    def by_time(self, seconds: float) -> Growth:
        """Return what becomes uncertain in so many seconds without odometry."""
        return Growth(self.max_speed * abs(seconds), np.radians(self.max_turn_rate) * abs(seconds))

    def by_odometry(self, travelled: Travelled) -> Growth:
        """Return what becomes uncertain on a way that odometry has measured."""
        return Growth(self.odometry_distance_error * travelled.distance, self.odometry_turn_error * travelled.turn)


@dataclass(frozen=True)
class Travelled:
    """How long a way was: distance in the odometry's units, and all turns together in radians."""

    distance: float
    turn: float


@dataclass(frozen=True)
class Growth:
    """By what the standard deviations of a pose grow: of the position in map units, of the rotation in radians."""

    translation: float
    rotation: float

    def added_to(self, covariance: np.ndarray, planar: bool) -> np.ndarray:
        """Return a covariance (6, 6) with this added; of a planar robot to x, y and yaw alone."""
        flat = 0.0 if planar else 1.0
        translation, rotation = self.translation**2, self.rotation**2
        axes = [translation, translation, flat * translation, flat * rotation, flat * rotation, rotation]
        return covariance + np.diag(axes)


def position_sigma(covariance: np.ndarray) -> float:
    """Return the standard deviation of the position along the axis of which least is known, by a covariance (6, 6)."""
    return _largest_sigma(covariance[:3, :3])


def rotation_sigma(covariance: np.ndarray) -> float:
    """Return the same of the rotation, in radians."""
    return _largest_sigma(covariance[3:, 3:])


def _largest_sigma(covariance: np.ndarray) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
