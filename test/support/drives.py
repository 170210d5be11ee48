"""Simulated drives: the same camera poses in a map's frame and in a robot's, with errors."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from gsfeatloc_ros.align.fit import Fit
from gsfeatloc_ros.align.pairs import Pairs
from gsfeatloc_ros.common.geometry import invert, make_pose, quaternion_from_matrix, so3_exp, so3_log
from gsfeatloc_ros.maps.similarity import Similarity


@dataclass(frozen=True)
class Errors:
    """Standard deviations: metres and degrees of each pose alone, and the share that each step's length is off by."""

    position: float = 0.0
    rotation: float = 0.0
    step: float = 0.0


def random_similarity(rng: np.random.Generator) -> Similarity:
    """Return S_robot_map, any rotation, a scale of about e or 1 / e."""
    return Similarity(float(np.exp(rng.normal())), so3_exp(rng.uniform(-2, 2, 3)), rng.normal(0, 5, 3))


def curve(count: int = 20) -> np.ndarray:
    """Return T_robot_camera (N, 4, 4) of a curve of 10 m on the ground, the camera looking ahead and about."""
    return np.array([_pose([3 * np.cos(t), 2 * np.sin(t), 0.5], t, 0.3 * np.sin(2 * t)) for t in _times(count)])


def line(count: int = 20) -> np.ndarray:
    """Return the same of 6 m straight ahead."""
    return np.array([_pose([1.5 * t, 0.0, 0.5], 0.0, 0.3 * np.sin(2 * t)) for t in _times(count)])


def as_pairs(true: np.ndarray, S_robot_map: Similarity, errors: Errors, rng: np.random.Generator) -> Pairs:
    """Return what localization and odometry say of true T_robot_camera (N, 4, 4), the errors all the odometry's."""
    back = S_robot_map.inverse()
    measured = [true[0]]
    for before, after in pairwise(true):
        step = invert(before) @ after
        step[:3, 3] *= 1 + errors.step * rng.normal()
        measured.append(measured[-1] @ step)
    for pose in measured:
        pose[:3, :3] = so3_exp(np.radians(errors.rotation) * rng.normal(size=3)) @ pose[:3, :3]
        pose[:3, 3] += errors.position * rng.normal(size=3)
    answers = np.array([back.transform_pose(pose) for pose in true])
    return Pairs(answers, np.array(measured), np.zeros((len(true), 2)))


def error_of(fit: Fit, S_robot_map: Similarity) -> np.ndarray:
    """Return by how much a fit is off (7,), as its covariance counts it."""
    off = fit.S_robot_map @ S_robot_map.inverse()
    centre = S_robot_map.inverse().transform(fit.centre[None])
    moved = fit.S_robot_map.transform(centre)[0] - fit.centre
    return np.concatenate([[np.log(off.scale)], so3_log(off.rotation), moved])


def write_tum(path: Path, poses: np.ndarray, start: float = 100.0) -> Path:
    """Write poses (N, 4, 4) as TUM, one a second."""
    lines = [
        " ".join(f"{value:.9f}" for value in (start + number, *pose[:3, 3], *quaternion_from_matrix(pose[:3, :3])))
        for number, pose in enumerate(poses)
    ]
    path.write_text("# stamp x y z qx qy qz qw\n" + "\n".join(lines) + "\n")
    return path


def _times(count: int) -> np.ndarray:
    return np.linspace(0, 4, count)


def _pose(position: list[float], heading: float, pitch: float) -> np.ndarray:
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return make_pose(so3_exp(np.array([0, 0, heading])) @ level @ so3_exp(np.array([pitch, 0, 0])), position)
