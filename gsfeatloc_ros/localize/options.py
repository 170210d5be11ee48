"""Settings of a Localizer."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsfeatloc_ros.common.geometry import isotropic_covariance
from gsfeatloc_ros.common.parameter import group, parameter
from gsfeatloc_ros.localize.evidence import Limits
from gsfeatloc_ros.pose.lift import LiftOptions
from gsfeatloc_ros.pose.solve import PoseOptions

MAX_SEED = 2**31 - 1


@dataclass(frozen=True)
class SearchOptions:
    """How the index of views is searched, where the prior's view does not show the image.

    Attributes:
        skipped: of the views that most speaks for, so many are left out: they were looked at in vain already.
        usual_covariance: (6, 6) of how far off the prior usually is, where its own allows for more: of an answer that
            is gone on from. It says what to try first, and forbids nothing; None for the prior's own.
    """

    max_seconds: float = parameter(
        3.0, "Longest search of the index, in seconds; what was begun by then is ended.", (0.0, 3600.0), live=True
    )
    max_views: int = parameter(
        100, "Most views of the index that are compared with an image; 0 for none.", (0, 1_000_000), live=True
    )
    skipped: int = 0
    usual_covariance: np.ndarray | None = field(default=None, compare=False)


@dataclass(frozen=True)
class LocalizerOptions:
    """Settings of a Localizer.

    The node has them, and those of `pose` and `limits`, as parameters `localizer.*`; those of `search` are `search.*`.
    """

    max_image_width: int = parameter(640, "Wider images are resized to this many pixels first.", (64, 16384), live=True)
    deadline: float = parameter(
        0.0,
        "Seconds after which a query ends with what it has, and says so; what was begun is ended. 0 for no end.",
        (0.0, 3600.0),
        live=True,
    )
    max_passes: int = parameter(4, "Most renders at estimates to which an image is tracked.", (1, 20), live=True)
    max_views: int = parameter(
        32, "Most other views searched when the prior's shows nothing of the image; 0 for none.", (0, 1000), live=True
    )
    prior_rotation: float = parameter(
        15.0, "Standard deviation of the prior in degrees about each axis.", (0.01, 180.0), live=True
    )
    prior_translation: float = parameter(
        0.5, "Standard deviation of the prior in map units along each axis.", (1e-6, 1e6), live=True
    )
    seed: int = parameter(
        0, "Seed of RANSAC and of the search: the same seed gives the same answer.", (0, MAX_SEED), live=True
    )
    search: SearchOptions = field(default_factory=SearchOptions, metadata=group("search"))
    pose: PoseOptions = field(default_factory=PoseOptions)
    limits: Limits = field(default_factory=Limits)
    lift: LiftOptions = field(default_factory=LiftOptions)

    def prior_covariance(self) -> np.ndarray:
        """Covariance (6, 6) of a prior that comes without one: x y z, rotation vector; map units and radians."""
        return isotropic_covariance(self.prior_translation, np.radians(self.prior_rotation))
