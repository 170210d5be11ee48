"""Poses that what agrees with an estimate leaves open, and from which more of the photo may be explained."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, moved, transform
from gsfeatloc_ros.pose.lift import LiftOptions, lift
from gsfeatloc_ros.pose.linear import POSE_PARAMETERS, linearize
from gsfeatloc_ros.render.base import Render

# What agrees leaves a pose open if the picture moves by more than so many pixels (RMS) over _REACH standard deviations:
# what is off by less is found by tracking.
_MIN_SHIFT = 4.0
_REACH = 2.0
# The picture is looked at in so many points across and down.
_POINTS = (16, 12)


def poses_left_open(
    camera: Camera, render: Render, pose: np.ndarray, covariance: np.ndarray, options: LiftOptions
) -> list[np.ndarray]:
    """Return two poses (4, 4), to either side of an estimate, along the way in which the picture moves most.

    Corners of one part of a photo, a plane say, fix the rest of it to within what the covariance says. If the rest is
    off by more than tracking reaches, it looks as if it were covered.

    Args:
        camera: pinhole.
        render: of the map near the estimate.
        pose: (4, 4) the estimate, T_map_camera.
        covariance: (6, 6) of it.
        options: which depths can be trusted.

    Returns:
        The poses; none where the picture keeps its place to within what tracking finds.
    """
    points = _points(camera, render, pose, options)
    linear = linearize(camera, pose, points)
    if linear is None or len(points) == 0:
        return []
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    by_deviation = linear.by_state[:, :, :POSE_PARAMETERS].reshape(-1, POSE_PARAMETERS) @ root
    _, shifts, directions = np.linalg.svd(by_deviation, full_matrices=False)
    if _REACH * shifts[0] < _MIN_SHIFT * np.sqrt(len(points)):
        return []
    step = _REACH * root @ directions[0]
    return [moved(pose, step), moved(pose, -step)]


def picture_shift(camera: Camera, render: Render, pose: np.ndarray, other: np.ndarray, options: LiftOptions) -> float:
    """Return by how many pixels (RMS) the picture moves from one pose (4, 4), of a render, to another.

    Infinite where nothing of it is seen from there, or its depths cannot be trusted. The others as of poses_left_open.
    """
    points = _points(camera, render, pose, options)
    here, there = (transform(invert(T), points) for T in (pose, other))
    ahead = (here[:, 2] > 0) & (there[:, 2] > 0)
    if not ahead.any():
        return float("inf")
    shifts = camera.project(there[ahead]) - camera.project(here[ahead])
    return float(np.sqrt((shifts**2).sum(axis=1).mean()))


def _points(camera: Camera, render: Render, pose: np.ndarray, options: LiftOptions) -> np.ndarray:
    """Return points (N, 3) of the map all over the picture, where its depths can be trusted."""
    across, down = (
        np.linspace(0, side - 1, count) for side, count in zip((camera.width, camera.height), _POINTS, strict=True)
    )
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    lifted = lift(render, camera, pose, pixels, options)
    return lifted.points[lifted.valid]
