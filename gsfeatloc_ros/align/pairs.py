"""Camera poses that are known in two frames: in the map's by localization, in the robot's by a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsfeatloc_ros.common.geometry import so3_log
from gsfeatloc_ros.replay.truth import Trajectory

# Radians. Orientations of a trajectory that all lie within this, while the camera turned by more, are no orientations.
_NO_TURN = np.radians(0.01)
_TURN = np.radians(3.0)


@dataclass(frozen=True, eq=False)
class Answer:
    """Where a photo was taken, in the map's frame.

    Attributes:
        stamp: in nanoseconds.
        T_map_camera: (4, 4), map units.
        variances: (2,) of the position along an axis (square map units) and the rotation about one (square radians);
            zeros where they are not known.
    """

    stamp: int
    T_map_camera: np.ndarray
    variances: np.ndarray


@dataclass(frozen=True, eq=False)
class Pairs:
    """N poses of the camera in both frames, in the order of time.

    Attributes:
        answers: (N, 4, 4) T_map_camera, map units.
        references: (N, 4, 4) T_robot_camera, metres.
        variances: (N, 2) of the answers, as of Answer.
        oriented: whether the rotations of `references` are known.
    """

    answers: np.ndarray
    references: np.ndarray
    variances: np.ndarray
    oriented: bool = True

    def __len__(self) -> int:
        return len(self.answers)

    def only(self, rows: np.ndarray) -> Pairs:
        """Return some of them: (M,) indices or (N,) bool."""
        return replace(
            self, answers=self.answers[rows], references=self.references[rows], variances=self.variances[rows]
        )

    def travelled(self) -> np.ndarray:
        """Return how long the way was up to each pose (N,), metres."""
        steps = np.linalg.norm(np.diff(self.references[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def match(answers: Sequence[Answer], trajectory: Trajectory, oriented: bool) -> Pairs:
    """Pair each answer with the trajectory (T_robot_camera) at its stamp; what has no pair is left out.

    Orientations that never change while the camera turns, as some files of positions have them, are not taken for any.
    """
    found = [(answer, trajectory.at(answer.stamp)) for answer in sorted(answers, key=lambda answer: answer.stamp)]
    known = [(answer, pose) for answer, pose in found if pose is not None]
    poses = np.array([answer.T_map_camera for answer, _ in known]).reshape(-1, 4, 4)
    references = np.array([pose for _, pose in known]).reshape(-1, 4, 4)
    variances = np.array([answer.variances for answer, _ in known]).reshape(-1, 2)
    still = _largest_turn(references) < _NO_TURN and _largest_turn(poses) > _TURN
    return Pairs(poses, references, variances, oriented and not still)


def _largest_turn(poses: np.ndarray) -> float:
    """Return the largest angle in radians between the first of poses (N, 4, 4) and another."""
    turns = [np.linalg.norm(so3_log(poses[0, :3, :3].T @ pose[:3, :3])) for pose in poses]
    return float(max(turns, default=0.0))
