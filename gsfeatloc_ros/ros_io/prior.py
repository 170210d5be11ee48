"""The prior: where the camera or the base roughly was, as it came."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from gsfeatloc_ros.common.geometry import isotropic_covariance
from gsfeatloc_ros.ros_io.decode import decode_covariance, decode_pose, frame_name, nanoseconds
from gsfeatloc_ros.ros_io.growth import GrowthOptions
from gsfeatloc_ros.ros_io.message_types import AnyPose, Odometry

# Variance of a coordinate of which nothing is known, in square map units or radians.
_UNKNOWN = 1e6
# Share of the usual deviations of a prior by which a planar robot may leave its plane: ramps, soft wheels.
_SHARE_OFF_PLANE = 0.2
# Radians by which a robot may have turned since its pose was saved (standard deviation).
_SAVED_ROTATION = np.pi / 3


class PriorSource(Enum):
    """Where a prior comes from. The value is what messages to people call it."""

    PRIOR = "prior"
    INITIAL_POSE = "initialpose"
    LAST_ANSWER = "last answer"
    REQUEST = "request's prior"
    UNCONFIRMED = "unconfirmed answer"
    SAVED = "saved pose"
    PLANE = "plane"

    @property
    def own(self) -> bool:
        """Whether it is an answer of the localizer's own; otherwise it came from outside, or from nowhere."""
        return self in (PriorSource.LAST_ANSWER, PriorSource.UNCONFIRMED, PriorSource.SAVED)


@dataclass(frozen=True)
class PriorPolicy:
    """What priors are poses of, and how uncertain they become with time.

    Attributes:
        map_frame: name of the map's frame.
        base_frame: name of the robot base's frame.
        of_base: whether priors are poses of the base; otherwise of the camera's optical frame.
        max_age: seconds for which a prior from outside holds as it is if no odometry carries it to the image's time; 0
            for ever. An older one becomes uncertain. None may be newer than the image by more.
        odometry_max_age: seconds over which odometry may carry it.
        translation_sigma, rotation_sigma: standard deviations, in map units and degrees, of a prior whose covariance is
            not known.
        growth: how fast it becomes uncertain.
        planar: whether the base stays on the plane z = 0 of the map, and upright.
    """

    map_frame: str = "map"
    base_frame: str = "base_link"
    of_base: bool = False
    max_age: float = 10.0
    odometry_max_age: float = 60.0
    translation_sigma: float = 0.5
    rotation_sigma: float = 15.0
    growth: GrowthOptions = field(default_factory=GrowthOptions)
    planar: bool = False

    def default_covariance(self) -> np.ndarray:
        """Return the covariance (6, 6) of a prior that comes without one."""
        return isotropic_covariance(self.translation_sigma, np.radians(self.rotation_sigma))

    def plane(self) -> Prior:
        """Return the prior of a base that stands somewhere on the plane z = 0 of the map, upright."""
        variances = self.default_covariance().diagonal() * _SHARE_OFF_PLANE**2
        variances[[0, 1, 5]] = _UNKNOWN
        return Prior(PriorSource.PLANE, 0, self.map_frame, self.base_frame, np.eye(4), np.diag(variances))

    def saved(self, T_map_camera: np.ndarray, sigma: float) -> Prior:
        """Return the prior that a pose (4, 4) of a run before is; the robot may be `sigma` map units away from it."""
        covariance = isotropic_covariance(sigma, _SAVED_ROTATION)
        return Prior(PriorSource.SAVED, 0, self.map_frame, "", T_map_camera, covariance)


@dataclass(frozen=True, eq=False)
class Prior:
    """Where the camera or the base roughly was.

    Attributes:
        source: where it comes from.
        stamp: in nanoseconds; 0 for none: then it holds at any time.
        frame: that it is given in.
        body: frame of the body whose pose it is; empty for the camera's optical frame.
        pose: (4, 4) in `frame`.
        covariance: (6, 6) about the axes of `frame` in ROS order, or None where it is not known.
    """

    source: PriorSource
    stamp: int
    frame: str
    body: str
    pose: np.ndarray
    covariance: np.ndarray | None


def decode_prior(message: AnyPose | Odometry, source: PriorSource, policy: PriorPolicy) -> Prior:
    """Decode a prior.

    Odometry says what it is the pose of; RViz's initial pose is of the base, others as the policy says.

    Raises:
        ValueError: the message cannot be used; the error says why.
    """
    name = source.value
    frame = frame_name(message.header.frame_id)
    if not frame:
        raise ValueError(f"{name} is in frame '': name the frame in its header, the map's or one that tf knows")
    if isinstance(message, Odometry):
        body = body_of(message, name)
    else:
        body = policy.base_frame if policy.of_base or source is PriorSource.INITIAL_POSE else ""
    stamp = nanoseconds(message.header.stamp)
    return Prior(source, stamp, frame, body, decode_pose(message, name), decode_covariance(message, name))


def body_of(message: Odometry, name: str) -> str:
    """Return the frame of the body whose poses odometry gives; raise ValueError where it does not say."""
    body = frame_name(message.child_frame_id)
    if not body:
        raise ValueError(
            f"{name} has no child_frame_id, so that nobody knows of what it is the pose: have its publisher name "
            "the frame, base_link say"
        )
    return body
