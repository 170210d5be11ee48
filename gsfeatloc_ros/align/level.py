"""An alignment by what is up and where the floor is: roll, pitch and height. The scale stays, heading and place too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from gsfeatloc_ros.align.alignment import Alignment
from gsfeatloc_ros.align.fit import UndeterminedError
from gsfeatloc_ros.align.floor import find_floor, surface_samples
from gsfeatloc_ros.align.gravity import Up
from gsfeatloc_ros.align.pairs import Answer
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.maps.similarity import Similarity

# Degrees of standard deviation beyond which nothing says what is up.
_MAX_SIGMA = 3.0
# Degrees. A floor that is farther off level than this is said to be.
_NOTABLE_TILT = 2.0


def level(up: Up, gaussians: GaussianMap, answers: Sequence[Answer], by_floor: bool, metres: bool) -> Alignment:
    """Return the similarity that puts up along z and the floor at z = 0.

    Args:
        up: in the frame in which the map lies.
        gaussians: the map, where it lies.
        answers: where photos were taken.
        by_floor: whether the floor says what is up, more finely than `up`.
        metres: whether the unit is the metre already.

    Raises:
        UndeterminedError: the photos differ about what is up, or there is no floor.
    """
    if np.degrees(up.sigma) > _MAX_SIGMA:
        raise UndeterminedError(
            f"{up.photos} photos say what is up only to {np.degrees(up.sigma):.1f} degrees (at most {_MAX_SIGMA:g}): "
            "is the camera mounted as was said, and the map right?"
        )
    cameras = np.array([answer.T_map_camera[:3, 3] for answer in answers])
    floor = find_floor(*surface_samples(gaussians), cameras, up.direction)
    tilt = float(np.degrees(np.arccos(np.clip(floor.normal @ up.direction, -1, 1))))
    vertical = floor.normal if by_floor else up.direction
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [vertical])
    S_robot_map = Similarity(1.0, turn.as_matrix(), -(turn.as_matrix() @ floor.point) * [0, 0, 1])
    heights = S_robot_map.transform(cameras)[:, 2]
    report = [
        f"up, by {up.photos} photos, to {np.degrees(up.sigma):.2f} degrees",
        f"turned by {np.degrees(turn.magnitude()):.2f} degrees",
        f"the floor, {100 * floor.share:.0f} % of what lies below the cameras, is {tilt:.2f} degrees off that",
        f"its Gaussians lie {floor.residual:.4f} units from it (median); z = 0 is the floor below the cameras",
        f"the cameras are {heights.min():.3f} to {heights.max():.3f} units above it",
        f"roll and pitch come from {'the floor' if by_floor else 'gravity'}; scale, heading, x and y are as before",
    ]
    if tilt > _NOTABLE_TILT:
        report.append(f"the floor is {tilt:.1f} degrees off level: a ramp, a table, or the camera is not level")
    return Alignment(S_robot_map, complete=metres, report=report)
