"""Whether a prior is so good that the photo can be tracked into the render there: features need not be found then."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.localize.prior import Prior
from gsfeatloc_ros.pose.lift import LiftOptions, lift
from gsfeatloc_ros.pose.linear import POSE_PARAMETERS, linearize
from gsfeatloc_ros.render.base import Render

# Optical flow finds the photo where it is off by at most this share of its width: of 857 photos of bonsai, lego and
# office, moved by this or less, 97 %; by half as much again every third one.
_REACH = 0.12
# What tracking in vain costs (a view is rendered anyway), as a share of what features cost when it is not.
_COST = 0.15
# A prior from which the photo is off by no more than about this many pixels is looked at in full size at once:
# one pass there costs less, then, than a small one before it.
_SETTLED = 4.0
# Pixels across and down a render at which it is told how far the photo may be off.
_GRID = (8, 6)


def is_worth_tracking(render: Render, camera: Camera, prior: Prior) -> bool:
    """Return whether it is cheaper, on average, to try to track a photo into the render at its prior first.

    It is where the chance that the photo is within reach is larger than the share of the cost.
    """
    sigma = expected_offset(render, camera, prior) / camera.width
    # What is off by a Gaussian along both axes is Rayleigh distributed.
    return bool(1.0 - np.exp(-((_REACH / max(sigma, 1e-9)) ** 2)) > _COST)


def may_be_settled(camera: Camera, prior: Prior) -> bool:
    """Return whether a photo may be within _SETTLED pixels of its prior, by what that knows of the rotation alone."""
    return bool(camera.K[0, 0] * np.sqrt(np.trace(prior.usual_covariance[3:, 3:]) / 3) <= _SETTLED)


def is_settled(render: Render, camera: Camera, prior: Prior) -> bool:
    """Return whether a photo usually is within _SETTLED pixels of its prior, by the full-size render there."""
    return expected_offset(render, camera, prior) <= _SETTLED


def expected_offset(render: Render, camera: Camera, prior: Prior) -> float:
    """Return by how many pixels the photo usually is off from a render at its prior: RMS, at a median pixel.

    Infinite where the map shows nothing.
    """
    lifted = lift(render, camera, prior.pose, _grid(camera.width, camera.height), LiftOptions())
    points = lifted.points[lifted.valid]
    if len(points) == 0:
        return float("inf")
    linear = linearize(camera, prior.pose, points)
    if linear is None:
        return float("inf")
    by_pose = linear.by_state[:, :, :POSE_PARAMETERS]
    variances = (by_pose @ prior.usual_covariance * by_pose).sum(axis=(1, 2))
    return float(np.sqrt(max(np.median(variances), 0.0)))


@lru_cache(maxsize=4)
def _grid(width: int, height: int) -> np.ndarray:
    """Return the pixels (48, 2) in the middles of the cells of a picture."""
    across, down = _GRID
    columns, rows = (np.arange(across) + 0.5) * width / across, (np.arange(down) + 0.5) * height / down
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
