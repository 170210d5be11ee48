"""The similarity that fits a drive best, and how well the drive determines it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.align.consensus import MIN_PAIRS, agreeing, residuals
from gsfeatloc_ros.align.noise import Noise, Usual, estimate_noise
from gsfeatloc_ros.align.pairs import Pairs
from gsfeatloc_ros.align.umeyama import umeyama
from gsfeatloc_ros.common.geometry import skew, so3_exp
from gsfeatloc_ros.maps.similarity import Similarity

# Of odometry by wheels or eyes, in metres and radians, and these a square root of a metre.
_POSITIONS, _ROTATIONS = Usual(0.01, 0.003), Usual(np.radians(0.3), np.radians(0.1))
# What is known before the drive, so that what it leaves open has a large deviation and not none: the logarithm of the
# scale, the rotation about each axis in radians, the translation in metres.
_WIDE = np.array([1.0, *[np.pi] * 3, *[1e3] * 3])
# More pairs than this tell nothing more of the noise, and cost the square of their number.
_MAX_PAIRS = 400
_ROUNDS = 10
# Of the scale and radians: after a smaller step the residuals say the same.
_SETTLED = 1e-6
_ROTATION, _TRANSLATION = slice(1, 4), slice(4, 7)
# Radians. What is less certain contradicts nothing.
_DETERMINED = np.radians(5.0)
# Standard deviations that are no chance.
_MAX_SIGMAS = 4.0


class UndeterminedError(ValueError):
    """A drive does not tell what is asked; the message says what, and what would."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A similarity and how well it is determined.

    Covariances are of (7,): the logarithm of the scale, the rotation about the robot's x, y and z (radians), and where
    the centre of the drive comes to lie in the robot's frame (metres).

    Attributes:
        S_robot_map: the similarity.
        covariance: (7, 7) by all.
        by_positions: (7, 7) by the positions alone.
        by_orientations: (7, 7) by the orientations alone; None where they are not known.
        centre: (3,) of the drive, robot's frame.
        positions: noise in metres.
        rotations: noise in radians; None where orientations are not known.
        pairs: those that agree.
        given: number of pairs that there were.
        between: (3,) rotation vector in radians from what the orientations alone say to what the positions alone say.
    """

    S_robot_map: Similarity
    covariance: np.ndarray
    by_positions: np.ndarray
    by_orientations: np.ndarray | None
    centre: np.ndarray
    positions: Noise
    rotations: Noise | None
    pairs: Pairs
    given: int
    between: np.ndarray

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale, as a share of it."""
        return float(np.sqrt(self.covariance[0, 0]))

    def worst_rotation(self) -> tuple[float, np.ndarray]:
        """Return the largest standard deviation of the rotation in radians, and the axis (3,) that it is about."""
        values, axes = np.linalg.eigh(self.covariance[_ROTATION, _ROTATION])
        return float(np.sqrt(values[-1])), axes[:, -1]

    @property
    def contradiction(self) -> float:
        """Angle in radians between what positions and orientations say of the rotation; 0 where that may be chance."""
        if self.by_orientations is None:
            return 0.0
        variances, axes = np.linalg.eigh((self.by_positions + self.by_orientations)[_ROTATION, _ROTATION])
        between = (axes.T @ self.between)[variances < _DETERMINED**2]
        significant = np.abs(between) > _MAX_SIGMAS * np.sqrt(variances[variances < _DETERMINED**2])
        return float(np.linalg.norm(between[significant]))


def fit_drive(pairs: Pairs, seed: int = 0) -> Fit:
    """Fit S_robot_map to pairs of poses, of which less than half may be wrong.

    RANSAC, then least squares weighted by the noise, which is estimated from the residuals in turn.

    Raises:
        UndeterminedError: there are too few pairs, or most do not agree with any similarity.
    """
    given = len(pairs)
    if given < MIN_PAIRS:
        raise UndeterminedError(
            f"{given} photos were localized and have a pose in the trajectory: at least {MIN_PAIRS} are needed"
        )
    if given > _MAX_PAIRS:
        pairs = pairs.only(np.linspace(0, given - 1, _MAX_PAIRS).astype(int))
    agree = agreeing(pairs, seed)
    pairs = pairs.only(agree)
    start = umeyama(pairs) if len(pairs) >= MIN_PAIRS else None
    if start is None:
        raise UndeterminedError(
            f"{agree.sum()} of {len(agree)} photos agree with one scale and rotation: did the camera move, and is the "
            "trajectory of the same drive, with the same clock?"
        )
    return _refined(pairs, start, given)


def _refined(pairs: Pairs, S_robot_map: Similarity, given: int) -> Fit:
    travelled = pairs.travelled()
    for _ in range(_ROUNDS):
        jacobian, centre = _jacobian(pairs, S_robot_map)
        moved, turned = residuals(pairs, S_robot_map)
        known = pairs.variances * [S_robot_map.scale**2, 1.0]
        positions = estimate_noise(moved, jacobian, travelled, known[:, 0], _POSITIONS)
        rotations = None
        by_positions, towards = _normal_equations(positions, jacobian, moved)
        by_orientations, more = np.zeros((7, 7)), np.zeros(7)
        if pairs.oriented:
            of_rotation = np.zeros((len(pairs), 3, 7))
            of_rotation[:, :, _ROTATION] = np.eye(3)
            rotations = estimate_noise(turned, of_rotation[:, :, _ROTATION], travelled, known[:, 1], _ROTATIONS)
            by_orientations, more = _normal_equations(rotations, of_rotation, turned)
        step = _covariance(by_positions + by_orientations) @ (towards + more)
        S_robot_map = _moved(S_robot_map, step, centre)
        if np.abs(step).max() < _SETTLED:
            break
    between = (_covariance(by_positions) @ towards - _covariance(by_orientations) @ more)[_ROTATION]
    return Fit(
        S_robot_map,
        _covariance(by_positions + by_orientations),
        _covariance(by_positions),
        _covariance(by_orientations) if pairs.oriented else None,
        centre,
        positions,
        rotations,
        pairs,
        given,
        between,
    )


def _jacobian(pairs: Pairs, S_robot_map: Similarity) -> tuple[np.ndarray, np.ndarray]:
    """Return how positions (N, 3, 7) move with a step, and the centre (3,) that they turn about."""
    points = S_robot_map.transform(pairs.answers[:, :3, 3])
    centre = points.mean(axis=0)
    arms = points - centre
    return np.concatenate(
        [arms[:, :, None], -skew(arms), np.broadcast_to(np.eye(3), (len(arms), 3, 3))], axis=2
    ), centre


def _moved(S_robot_map: Similarity, step: np.ndarray, centre: np.ndarray) -> Similarity:
    """Return a similarity after a step (7,) about a centre (3,)."""
    growth, turn = float(np.exp(step[0])), so3_exp(step[_ROTATION])
    about = Similarity(growth, turn, centre + step[_TRANSLATION] - growth * turn @ centre)
    return about @ S_robot_map


def _normal_equations(noise: Noise, jacobian: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the information (7, 7) of a component, and where its residuals (N, 3) pull (7,)."""
    white = np.einsum("ij,jkp->ikp", noise.whitening, jacobian).reshape(-1, 7)
    return white.T @ white, white.T @ (noise.whitening @ residual).reshape(-1)


def _covariance(information: np.ndarray) -> np.ndarray:
    # In units of what is known before: metres squared beside radians squared would spoil the inverse.
    scaled = information * np.outer(_WIDE, _WIDE) + np.eye(7)
    return np.linalg.inv(scaled) * np.outer(_WIDE, _WIDE)
