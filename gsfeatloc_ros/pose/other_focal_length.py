"""Wholly different focal lengths that may explain a photo better, which a fit near one pose does not see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.pose.solve import Correspondences, PoseOptions, reprojection_errors, solve_pose

# How much longer than calibrated the focal lengths are that are tried, relative, and half of what lies between them.
_OTHERS = (-0.12, -0.08, -0.04, 0.04, 0.08, 0.12)
STEP_SIGMA = 0.02
# Another one is worth a closer look if it explains such a share of the calibration's matches, and so many at all:
# features are few, and do not decide.
_MIN_SHARE, _MIN_MATCHES = 0.9, 12


@dataclass(frozen=True, eq=False)
class OtherFocalLength:
    """Another focal length than the calibrated one.

    Attributes:
        error: how much longer it is, relative; to within STEP_SIGMA.
        T_map_camera: (4, 4) the pose that it gives.
    """

    error: float
    T_map_camera: np.ndarray


def other_focal_lengths(
    camera: Camera,
    T_map_camera: np.ndarray,
    found: Correspondences,
    options: PoseOptions,
    plausible: Callable[[np.ndarray], bool],
) -> list[OtherFocalLength]:
    """Return the focal lengths that explain about as many matches as the calibrated one, or more.

    With a wrong one a part of a photo may agree with a pose, and nothing else: the corners beside are so far off that
    tracking does not find them. Features are found there too.

    Args:
        camera: as calibrated, pinhole.
        T_map_camera: (4, 4) the pose that the calibration gives.
        found: matches of features.
        options: of the solver.
        plausible: whether a pose (4, 4) may be the photo's.
    """
    agreeing = np.sum(reprojection_errors(camera, T_map_camera, found) <= options.max_reprojection_error)
    enough = max(_MIN_SHARE * agreeing, _MIN_MATCHES)
    solutions = ((error, solve_pose(camera.zoomed(error), found, options, 0, plausible)) for error in _OTHERS)
    return [
        OtherFocalLength(error, solution.T_map_camera)
        for error, solution in solutions
        if solution and solution.inliers.sum() >= enough and plausible(solution.T_map_camera)
    ]
