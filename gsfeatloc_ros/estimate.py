"""The answer of the localizer."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from gsfeatloc_ros.match.base import Matches
from gsfeatloc_ros.render.base import Render


class Status(Enum):
    """Whether the pose of an Estimate may be used."""

    LOCALIZED = "localized"
    FAILED = "failed"


@dataclass(frozen=True, eq=False)
class Estimate:
    """Where a photo was taken, or why that could not be said.

    Attributes:
        status: LOCALIZED: the pose is an answer. FAILED: there is none; the prior is never passed off as one.
        reason: one sentence in words, for a log or a diagnostic.
        T_map_camera: (4, 4) float64 pose of the camera (optical axes) in the map frame; None when FAILED.
        covariance: (6, 6) float64 in ROS order (x y z, rotation about x y z), translation in map units, rotation in
            radians, both about the axes of the map frame at the camera centre; None when FAILED.
        matches: number of 2D-2D matches of the final pass.
        inliers: number of 2D-3D matches that agree with the pose.
        reprojection_error: RMS of the inliers' reprojection errors in pixels of the localized image; NaN when FAILED.
        passes: number of renders that were matched.
        milliseconds: wall time of each stage by name, with "total".
        correspondences: pixels of the inliers (photo, last render), photo pixels as observed (distorted).
        last_render: the last render that was matched, for pictures.
    """

    status: Status
    reason: str
    T_map_camera: np.ndarray | None = None
    covariance: np.ndarray | None = None
    matches: int = 0
    inliers: int = 0
    reprojection_error: float = float("nan")
    passes: int = 0
    milliseconds: dict[str, float] = field(default_factory=dict)
    correspondences: Matches | None = None
    last_render: Render | None = None

    @property
    def localized(self) -> bool:
        """Whether there is a pose to use."""
        return self.status is Status.LOCALIZED
