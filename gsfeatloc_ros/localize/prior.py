"""What is known of the camera's pose before the photo is looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.localize.evidence import deviation
from gsfeatloc_ros.localize.options import LocalizerOptions


@dataclass(frozen=True, eq=False)
class Prior:
    """A pose (4, 4) T_map_camera with its covariance (6, 6), and that of priors which come without."""

    pose: np.ndarray
    covariance: np.ndarray
    default_covariance: np.ndarray

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
        return Prior(
            np.asarray(T_map_camera, np.float64), np.asarray(covariance, np.float64), options.prior_covariance()
        )

    def deviation(self, pose: np.ndarray) -> float:
        """Return how far a pose (4, 4) is from it in standard deviations."""
        return deviation(pose, self.pose, self.covariance, self.default_covariance)
