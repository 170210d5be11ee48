"""What is known of the camera's pose before the photo is looked at."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsfeatloc_ros.common.geometry import so3_log
from gsfeatloc_ros.localize.options import LocalizerOptions

# The least variance of a prior, as a share of the variance of a prior that comes without covariance: priors may claim
# to know a coordinate exactly, as RViz's planar ones do.
_MIN_VARIANCE_SHARE = 0.01
# Cameras whose optical axes are no farther apart look the same way.
_SAME_WAY = math.cos(math.radians(45.0))
# A prior whose standard deviations about all axes are smaller knows which way is up: three of them are within what
# features of pictures that are the same way up may be turned by.
_MAX_SIGMA_OF_THE_WAY_UP = math.radians(20.0)


@dataclass(frozen=True, eq=False)
class Prior:
    """A pose (4, 4) T_map_camera with its covariance (6, 6), that of priors which come without, and its usual one."""

    pose: np.ndarray
    covariance: np.ndarray
    default_covariance: np.ndarray
    usual_covariance: np.ndarray

    @staticmethod
    def of(T_map_camera: np.ndarray | None, covariance: np.ndarray | None, options: LocalizerOptions) -> Prior | None:
        """Return a prior pose (4, 4) with its covariance (6, 6), by default that of the options; None for no pose.

        Raises:
            ValueError: the pose is not a finite (4, 4) one, or the covariance not a finite (6, 6) matrix.
        """
        if T_map_camera is None:
            return None
        if np.shape(T_map_camera) != (4, 4) or not np.isfinite(T_map_camera).all():
            raise ValueError("the prior must be a finite 4x4 pose")
        if covariance is None:
            covariance = options.prior_covariance()
        if np.shape(covariance) != (6, 6) or not np.isfinite(covariance).all():
            raise ValueError("the prior's covariance must be a finite 6x6 matrix")
        covariance, usual = np.asarray(covariance, np.float64), options.search.usual_covariance
        return Prior(
            np.asarray(T_map_camera, np.float64),
            covariance,
            options.prior_covariance(),
            covariance if usual is None else usual,
        )

    def deviation(self, pose: np.ndarray) -> float:
        """Return the Mahalanobis distance of a pose (4, 4) T_map_camera from it.

        A hundredth of the default covariance is added to its own.
        """
        unit, axes, sigmas = self._spread
        step = np.concatenate([pose[:3, 3] - self.pose[:3, 3], so3_log(pose[:3, :3] @ self.pose[:3, :3].T)])
        return float(np.linalg.norm(axes.T @ (step / unit) / sigmas))

    def roll_deg(self, pose: np.ndarray) -> float:
        """Return by how many degrees a pose (4, 4) T_map_camera is turned about its optical axis; NaN elsewhere.

        It is the twist of the rotation between the two; elsewhere is where the pose does not look the same way.
        """
        rotation = self.pose[:3, :3].T @ pose[:3, :3]
        if rotation[2, 2] < _SAME_WAY:
            return math.nan
        return math.degrees(math.atan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1]))

    @property
    def knows_the_way_up(self) -> bool:
        """Whether a photo from where it says is the same way up as the view from there."""
        return bool(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1] < _MAX_SIGMA_OF_THE_WAY_UP**2)

    @cached_property
    def _spread(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Units (6,) of the coordinates, axes (6, 6) of the covariance in these, and deviations (6,) along them."""
        # In units of the default deviations; what is no covariance (correlations beyond 1) opens no gate.
        unit = np.sqrt(self.default_covariance.diagonal())
        values, axes = np.linalg.eigh(0.5 * (self.covariance + self.covariance.T) / np.outer(unit, unit))
        return unit, axes, np.sqrt(np.clip(values, 0.0, None) + _MIN_VARIANCE_SHARE)
