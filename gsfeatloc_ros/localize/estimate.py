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
    REJECTED = "rejected"
    FAILED = "failed"


@dataclass(frozen=True, eq=False)
class Estimate:
    """Where a photo was taken, or why that could not be said.

    Attributes:
        status: LOCALIZED: the pose is an answer. REJECTED: a pose was found, but the map seen from there does not match
            the photo. FAILED: no pose was found. Neither has an answer; the prior is never passed off as one.
        reason: one sentence in words, for a log or a diagnostic.
        T_map_camera: (4, 4) float64 pose of the camera (optical axes) in the map frame; None unless LOCALIZED.
        covariance: (6, 6) float64 in ROS order (x y z, rotation about x y z), translation in map units, rotation in
            radians, both about the axes of the map frame at the camera centre; None unless LOCALIZED.
        matches: number of the photo's corners that were found in the last render; of matches where no pose was found.
        inliers: number of those that have a depth and agree with the pose.
        inlier_ratio: share that agrees, with some allowance for blur, of those that have a depth; NaN without pose.
        coverage: share of the photo's cells, in a grid of 8 x 6, that hold an inlier.
        agreement: correlation of photo and render at the estimate (pose/acceptance.py); NaN where it cannot be said.
        reprojection_error: RMS of the inliers' reprojection errors in pixels of the localized image; NaN without pose.
        passes: number of renders at estimates.
        views: number of other views than the prior's that were searched.
        milliseconds: wall time of each stage by name, with "total".
        correspondences: pixels of the inliers (photo, last render), of the photo without distortion.
        last_render: the last render that was matched, for pictures.
    """

    status: Status
    reason: str
    T_map_camera: np.ndarray | None = None
    covariance: np.ndarray | None = None
    matches: int = 0
    inliers: int = 0
    inlier_ratio: float = float("nan")
    coverage: float = 0.0
    agreement: float = float("nan")
    reprojection_error: float = float("nan")
    passes: int = 0
    views: int = 0
    milliseconds: dict[str, float] = field(default_factory=dict)
    correspondences: Matches | None = None
    last_render: Render | None = None

    @property
    def localized(self) -> bool:
        """Whether there is a pose to use."""
        return self.status is Status.LOCALIZED
