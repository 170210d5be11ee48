"""A stretch of a drive: how answers and odometry disagree on the motion from each answer to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from gsfeatloc_ros.common.geometry import skew

# Seconds from an answer's stamp at which it is kept where the odometry was.
OFFSETS = np.linspace(-0.3, 0.3, 13)
# Map units and radians by which odometry may be off on any leg: interpolation, the jitter of stamps.
_FLOOR = (1e-3, 1e-3)
# Places in a vector of corrections (8,).
SCALE, DELAY, LEVER, ROTATION = slice(0, 1), slice(1, 2), slice(2, 5), slice(5, 8)
CORRECTIONS = 8
# Diagonals of the residuals' covariance, from the main one downwards, that are not zero: legs share the answer between.
_BAND = 12
# Of the difference quotients.
_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class Keyframe:
    """An answer, and where odometry says that the body was.

    Attributes:
        T_map_camera: (4, 4) the answer.
        covariance: (6, 6) of it, in ROS order about the map's axes.
        T_body_camera: (4, 4) where the camera is said to be on the body whose poses odometry gives.
        T_odom_body: (len(OFFSETS), 4, 4) the body at the answer's stamp + OFFSETS.
    """

    T_map_camera: np.ndarray
    covariance: np.ndarray
    T_body_camera: np.ndarray
    T_odom_body: np.ndarray


class Drive:
    """Keyframes in the order of their stamps; a leg is the motion of the camera from one to the next.

    What may be wrong is a vector of corrections (8,): by what share the map is too small, by how many seconds the
    stamps of images are late, by how much the camera is elsewhere on the body (3,) and by how much it is turned there
    (3,) (metres, radians, axes of the body).

    Args:
        keyframes: two at least.
    """

    def __init__(self, keyframes: Sequence[Keyframe]) -> None:
        answers = np.array([keyframe.T_map_camera for keyframe in keyframes])
        mounting = np.array([keyframe.T_body_camera for keyframe in keyframes])
        odometry = np.array([keyframe.T_odom_body for keyframe in keyframes])
        self._positions, self._rotations = answers[:, :3, 3], answers[:, :3, :3]
        self._levers, self._mountings = mounting[:, :3, 3], mounting[:, :3, :3]
        self._track = odometry[:, :, :3, 3]
        self._middle = odometry[:, len(OFFSETS) // 2, :3, :3]
        turns = np.swapaxes(self._middle, 1, 2)[:, None] @ odometry[:, :, :3, :3]
        self._turns = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(*turns.shape[:2], 3)
        self._answer_band = _band(self._answer_covariance([keyframe.covariance for keyframe in keyframes]))

    def residuals(self, corrections: np.ndarray) -> np.ndarray:
        """Return by how much the legs of answers are off from those of the odometry with these corrections.

        (6 legs,): of each leg the translation, then the rotation vector, in the axes of the body.
        """
        positions, rotations = self._body_at(-corrections[DELAY][0])
        levers = self._levers + corrections[LEVER]
        mountings = Rotation.from_rotvec(corrections[ROTATION]).as_matrix() @ self._mountings
        cameras, axes = positions + _applied(rotations, levers), rotations @ mountings
        answered = (1.0 + corrections[SCALE][0]) * _moves(self._positions, self._rotations)
        off = _turns(axes).swapaxes(1, 2) @ _turns(self._rotations)
        translation = _applied(self._mountings[:-1], answered - _moves(cameras, axes))
        rotation = _applied(self._mountings[1:], Rotation.from_matrix(off).as_rotvec())
        return np.hstack([translation, rotation]).ravel()

    def jacobian(self, corrections: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the derivatives (6 legs, columns) of the residuals by some of the corrections."""
        ends = [corrections + sign * _STEP * np.eye(CORRECTIONS)[columns] for sign in (1.0, -1.0)]
        up, down = (np.array([self.residuals(end) for end in side]) for side in ends)
        return (up - down).reshape(len(columns), self._answer_band.shape[1]).T / (2.0 * _STEP)

    def covariance(self, noise: float) -> np.ndarray:
        """Return the covariance of the residuals where all is right, as a band (_BAND, 6 legs): see `_band`.

        Args:
            noise: share of the way, and of the turn, by which odometry is off on a leg (standard deviation).
        """
        way = np.linalg.norm(np.diff(self._track[:, len(OFFSETS) // 2], axis=0), axis=1)
        turn = np.linalg.norm(Rotation.from_matrix(_turns(self._middle)).as_rotvec(), axis=1)
        swing = turn * np.linalg.norm(self._levers[:-1], axis=1)
        sigmas = np.column_stack([np.hypot(_FLOOR[0], noise * (way + swing)), np.hypot(_FLOOR[1], noise * turn)])
        band = self._answer_band.copy()
        band[0] += np.repeat(sigmas**2, 3, axis=1).ravel()
        return band

    def _body_at(self, offset: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (n, 3) and rotations (n, 3, 3) of the body so many seconds after the stamps."""
        place = (offset - OFFSETS[0]) / (OFFSETS[1] - OFFSETS[0])
        before = int(np.clip(place, 0, len(OFFSETS) - 2))
        share = place - before
        position, turn = (
            (1.0 - share) * values[:, before] + share * values[:, before + 1] for values in (self._track, self._turns)
        )
        return position, self._middle @ Rotation.from_rotvec(turn).as_matrix()

    def _answer_covariance(self, covariances: Sequence[np.ndarray]) -> np.ndarray:
        """Return the part (6 legs, 6 legs) of the residuals' covariance that is the answers', to first order.

        Two legs that meet in an answer share its error.
        """
        legs = len(covariances) - 1
        effect = np.zeros((6 * legs, 6 * len(covariances)))
        into_body = self._mountings[:-1] @ np.swapaxes(self._rotations[:-1], 1, 2)
        into_next = self._mountings[1:] @ np.swapaxes(self._rotations[1:], 1, 2)
        swings = into_body @ skew(np.diff(self._positions, axis=0))
        for leg in range(legs):
            row, start, end = 6 * leg, 6 * leg, 6 * (leg + 1)
            effect[row : row + 3, start : start + 3] = -into_body[leg]
            effect[row : row + 3, start + 3 : start + 6] = swings[leg]
            effect[row : row + 3, end : end + 3] = into_body[leg]
            effect[row + 3 : row + 6, start + 3 : start + 6] = -into_next[leg]
            effect[row + 3 : row + 6, end + 3 : end + 6] = into_next[leg]
        return effect @ block_diag(*covariances) @ effect.T


def _band(matrix: np.ndarray) -> np.ndarray:
    """Return up to _BAND diagonals (_BAND, n) of a matrix (n, n), the main one first, as LAPACK has band matrices."""
    return np.array([np.pad(matrix.diagonal(-below), (0, below)) for below in range(min(_BAND, len(matrix)))])


def _applied(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", matrices, vectors)


def _moves(positions: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the way (n - 1, 3) from each position to the next, in the axes (n, 3, 3) at its beginning."""
    return np.einsum("nji,nj->ni", axes[:-1], np.diff(positions, axis=0))


def _turns(axes: np.ndarray) -> np.ndarray:
    """Return the rotation (n - 1, 3, 3) from each of the axes to the next."""
    return np.swapaxes(axes[:-1], 1, 2) @ axes[1:]
