"""Whether a wholly different focal length explains a photo better, which a fit near one pose does not see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.pose.solve import Correspondences, PoseOptions, reprojection_errors, solve_pose

# How much longer than calibrated the focal lengths are that are tried, relative, the nearest first; and half of what
# lies between them.
_OTHERS = (-0.04, 0.04, -0.08, 0.08, -0.12, 0.12)
STEP_SIGMA = 0.02
# Another one is worth a closer look if it explains so many matches more, and so many at all.
_LEAST_MORE, _MIN_MATCHES = 3, 12


@dataclass(frozen=True, eq=False)
class OtherFocalLength:
    """Another focal length than the calibrated one.

    Attributes:
        error: how much longer it is, relative; to within STEP_SIGMA.
        T_map_camera: (4, 4) the pose that it gives.
    """

    error: float
    T_map_camera: np.ndarray


def other_focal_length(
    camera: Camera,
    T_map_camera: np.ndarray,
    found: Correspondences,
    options: PoseOptions,
    plausible: Callable[[np.ndarray], bool],
) -> OtherFocalLength | None:
    """Return the focal length that explains more matches than the calibrated one; None where there is none.

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
    most, best = max(agreeing + _LEAST_MORE, _MIN_MATCHES - 1), None
    for error in _OTHERS:
        solution = solve_pose(camera.zoomed(error), found, options, 0, plausible)
        if solution and solution.inliers.sum() > most and plausible(solution.T_map_camera):
            most, best = solution.inliers.sum(), OtherFocalLength(error, solution.T_map_camera)
    return best
