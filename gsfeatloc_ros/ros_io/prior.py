"""The prior: where the camera or the base roughly was, as it came."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from gsfeatloc_ros.ros_io.decode import decode_covariance, decode_pose, nanoseconds
from gsfeatloc_ros.ros_io.message_types import AnyPose


class PriorSource(Enum):
    """Where a prior comes from. The value is what messages to people call it."""

    PRIOR = "prior"
    INITIAL_POSE = "initialpose"
    LAST_ANSWER = "last answer"
    REQUEST = "request's prior"


@dataclass(frozen=True)
class PriorPolicy:
    """What priors are poses of, and how old they may be.

    Attributes:
        map_frame: name of the map's frame.
        base_frame: name of the robot base's frame.
        of_base: whether priors are poses of the base; otherwise of the camera's optical frame.
        max_age: seconds by which a prior may be older or newer than the image if no odometry carries it to the image's
            time; 0 for no limit.
        odometry_max_age: seconds over which odometry may carry it.
    """

    map_frame: str = "map"
    base_frame: str = "base_link"
    of_base: bool = False
    max_age: float = 10.0
    odometry_max_age: float = 60.0


@dataclass(frozen=True, eq=False)
class Prior:
    """Where the camera or the base roughly was.

    Attributes:
        source: where it comes from.
        stamp: in nanoseconds; 0 for none: then it holds at any time.
        frame: that it is given in.
        of_base: whether it is the pose of the base; otherwise of the camera's optical frame.
        pose: (4, 4) in `frame`.
        covariance: (6, 6) about the axes of `frame` in ROS order, or None where it is not known.
    """

    source: PriorSource
    stamp: int
    frame: str
    of_base: bool
    pose: np.ndarray
    covariance: np.ndarray | None


def decode_prior(message: AnyPose, source: PriorSource, policy: PriorPolicy) -> Prior:
    """Decode a prior; RViz's initial pose is of the base in any case, others as the policy says.

    Raises:
        ValueError: the message cannot be used; the error says why.
    """
    name = source.value
    if not message.header.frame_id:
        raise ValueError(f"{name} is in frame '': name the frame in its header, the map's or one that tf knows")
    return Prior(
        source,
        nanoseconds(message.header.stamp),
        message.header.frame_id,
        policy.of_base or source is PriorSource.INITIAL_POSE,
        decode_pose(message, name),
        decode_covariance(message, name),
    )
