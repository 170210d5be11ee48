"""The answer of the localizer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.localize.evidence import Evidence
from gsfeatloc_ros.localize.protection import ProtectionLevel, protection_level
from gsfeatloc_ros.match.base import Matches
from gsfeatloc_ros.render.base import Render


class Status(Enum):
    """Whether the pose of an Estimate may be used."""

    LOCALIZED = "localized"
    REJECTED = "rejected"
    FAILED = "failed"
    AMBIGUOUS = "ambiguous"


@dataclass(frozen=True, eq=False)
class Estimate:
    """Where a photo was taken, or why that could not be said.

    Attributes:
        status: LOCALIZED: the pose is an answer. REJECTED: a pose was found, but the map seen from there does not match
            the photo. FAILED: no pose was found. AMBIGUOUS: several poses explain it equally well. None of these three
            has an answer; the prior is never passed off as one.
        reason: one sentence in words, for a log or a diagnostic.
        T_map_camera: (4, 4) float64 pose of the camera (optical axes) in the map frame; None unless LOCALIZED.
        covariance: (6, 6) float64 in ROS order (x y z, rotation about x y z), translation in map units, rotation in
            radians, both about the axes of the map frame at the camera centre; None unless LOCALIZED.
        evidence: the numbers behind it.
        milliseconds: wall time of each stage by name, with "total".
        candidates: (4, 4) poses that explain the photo equally well; none unless AMBIGUOUS.
    """

    status: Status
    reason: str
    T_map_camera: np.ndarray | None = None
    covariance: np.ndarray | None = None
    evidence: Evidence = field(default_factory=Evidence)
    milliseconds: dict[str, float] = field(default_factory=dict)
    candidates: tuple[np.ndarray, ...] = ()

    @property
    def protection(self) -> ProtectionLevel | None:
        """How far the pose may be off; None unless LOCALIZED."""
        return None if self.covariance is None else protection_level(self.covariance)

    @property
    def localized(self) -> bool:
        """Whether there is a pose to use."""
        return self.status is Status.LOCALIZED


@dataclass(frozen=True, eq=False)
class Trace:
    """An estimate with the pictures that it was made from, to look at.

    Attributes:
        estimate: the answer.
        photo: the photo, undistorted and resized.
        render: the last render that was compared with the photo; None where there was none. Of an answer, it is within
            half a pixel of the estimate, and of the photo's size.
        correspondences: pixels of the inliers (photo, render).
        changed: makes the mask of where the photo shows something else than the map: (H, W) uint8, 255 there; None
            where no pose was found.
        searched: (4, 4) each, T_map_camera of the views of the map in which the photo was looked for: the prior's,
            those of the index, and others that were rendered to find it.
    """

    estimate: Estimate
    photo: Photo
    render: Render | None = None
    correspondences: Matches = field(default_factory=Matches.none)
    changed: Callable[[], np.ndarray] | None = None
    searched: tuple[np.ndarray, ...] = ()
