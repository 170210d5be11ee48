"""An alignment by what is up and where the floor is, or by points on the floor: roll, pitch and height.

The scale stays, heading and place too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from gsfeatloc_ros.align.alignment import Alignment
from gsfeatloc_ros.align.fit import UndeterminedError
from gsfeatloc_ros.align.gravity import Up
from gsfeatloc_ros.align.pairs import Answer
from gsfeatloc_ros.inspect.floor import find_floor, surface_samples
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.maps.similarity import Similarity

# Degrees of standard deviation beyond which nothing says what is up.
_MAX_SIGMA = 3.0
# Degrees. A floor that is farther off level than this is said to be.
_NOTABLE_TILT = 2.0
# Of points on the floor: how wide they lie, as a share of how long.
_LEAST_WIDTH = 0.05


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
    if floor is None:
        raise UndeterminedError("the map has no level plane below the cameras: is what is up right?")
    tilt = float(np.degrees(np.arccos(np.clip(floor.normal @ up.direction, -1, 1))))
    S_robot_map = _standing(floor.normal if by_floor else up.direction, floor.point)
    heights = S_robot_map.transform(cameras)[:, 2]
    report = [
        f"up, by {up.photos} photos, to {np.degrees(up.sigma):.2f} degrees",
        f"turned by {_turn_deg(S_robot_map):.2f} degrees",
        f"the floor, {100 * floor.share:.0f} % of what lies below the cameras, is {tilt:.2f} degrees off that",
        f"its Gaussians lie {floor.residual:.4f} units from it (median); z = 0 is the floor below the cameras",
        f"the cameras are {heights.min():.3f} to {heights.max():.3f} units above it",
        f"roll and pitch come from {'the floor' if by_floor else 'gravity'}; scale, heading, x and y are as before",
    ]
    if tilt > _NOTABLE_TILT:
        report.append(f"the floor is {tilt:.1f} degrees off level: a ramp, a table, or the camera is not level")
    return Alignment(S_robot_map, complete=metres, report=report)


def level_by_points(points: np.ndarray, above: np.ndarray, metres: bool) -> Alignment:
    """Return the similarity that puts points on the floor to z = 0.

    Args:
        points: (N, 3), at least three, in the frame in which the map lies.
        above: (3,) any point above the floor.
        metres: whether the unit is the metre already.

    Raises:
        UndeterminedError: the points are fewer than three, or lie on a line.
    """
    centre = points.mean(axis=0)
    _, lengths, axes = np.linalg.svd(points - centre)
    if len(points) < 3 or not lengths[1] > _LEAST_WIDTH * lengths[0]:
        raise UndeterminedError("points on a line do not tell what is level: take three that are far apart")
    normal = axes[2] * (1.0 if axes[2] @ (above - centre) >= 0 else -1.0)
    S_robot_map = _standing(normal, centre)
    off = float(np.abs((points - centre) @ normal).max())
    report = [
        f"the floor is the plane through {len(points)} points, which lie up to {off:.4f} units from it",
        f"turned by {_turn_deg(S_robot_map):.2f} degrees",
        "roll and pitch come from these points; scale, heading, x and y are as before",
    ]
    return Alignment(S_robot_map, complete=metres, report=report)


def _standing(vertical: np.ndarray, point: np.ndarray) -> Similarity:
    """Return the similarity that turns a direction (3,) to z the shortest way, and puts a point (3,) to z = 0."""
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [vertical])
    return Similarity(1.0, turn.as_matrix(), -(turn.as_matrix() @ point) * [0, 0, 1])


def _turn_deg(similarity: Similarity) -> float:
    return float(np.degrees(Rotation.from_matrix(similarity.rotation).magnitude()))
