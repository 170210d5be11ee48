"""Whether a wholly different focal length explains a photo better, which a fit near one pose does not see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.pose.solve import Correspondences, PoseOptions, reprojection_errors, solve_pose

# How much longer than calibrated the focal lengths are that are tried, relative, and half of what lies between them.
_OTHERS = (-0.12, -0.08, -0.04, 0.04, 0.08, 0.12)
STEP_SIGMA = 0.02
# Another one is the right one if it explains so many times as many matches, and so many more: chance makes it a few.
_CLEARLY_MORE, _LEAST_MORE = 1.2, 10


def other_focal_length(
    camera: Camera,
    T_map_camera: np.ndarray,
    found: Correspondences,
    options: PoseOptions,
    plausible: Callable[[np.ndarray], bool],
) -> float:
    """Return how much longer than calibrated, relative, a focal length is that explains clearly more; 0 for none.

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
    most, best = max(_CLEARLY_MORE * agreeing, agreeing + _LEAST_MORE), 0.0
    for error in _OTHERS:
        longer = replace(camera, K=camera.K @ np.diag([1 + error, 1 + error, 1.0]))
        solution = solve_pose(longer, found, options, 0, plausible)
        if solution and solution.inliers.sum() > most and plausible(solution.T_map_camera):
            most, best = solution.inliers.sum(), error
    return best
