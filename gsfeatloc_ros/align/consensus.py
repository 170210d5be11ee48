"""Which pairs agree: RANSAC over minimal sets, scored by the median, so that it needs no threshold.

Rousseeuw, "Least median of squares regression", JASA 1984: right as long as more than half of the pairs are.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np
from scipy.spatial.transform import Rotation

from gsfeatloc_ros.align.pairs import Pairs
from gsfeatloc_ros.align.umeyama import ARM, umeyama
from gsfeatloc_ros.maps.similarity import Similarity

MIN_PAIRS = 5
"""Fewer cannot tell a wrong pair from a right one."""
# Pairs that fix a similarity.
_SAMPLE = 3
# Samples tried: with half of the pairs wrong, all of so many have a wrong one once in a million.
_SAMPLES = 100
# The median of the length of a vector of three normal errors, over their standard deviation.
_MEDIAN_LENGTH = 1.538
# Standard deviations from which on a pair does not agree: one in a thousand of normal errors.
_MAX_SIGMAS = 4.0
# Metres and radians. Nobody measures better: what is nearer than four times this agrees.
_LEAST_SIGMAS = np.array([0.002, np.radians(0.1)])
_ROUNDS = 5


def residuals(pairs: Pairs, S_robot_map: Similarity) -> tuple[np.ndarray, np.ndarray]:
    """Return reference minus answer in the robot's frame: metres (N, 3) and rotation vectors in radians (N, 3)."""
    positions = pairs.references[:, :3, 3] - S_robot_map.transform(pairs.answers[:, :3, 3])
    turned = S_robot_map.rotation @ pairs.answers[:, :3, :3]
    rotations = np.einsum("nij,nkj->nik", pairs.references[:, :3, :3], turned)
    return positions, Rotation.from_matrix(rotations).as_rotvec()


def agreeing(pairs: Pairs, seed: int) -> np.ndarray:
    """Return which pairs agree with one similarity: (N,) bool; none where there is no similarity.

    Args:
        pairs: at least MIN_PAIRS.
        seed: of the samples.
    """
    best, best_error = None, np.inf
    for rows in _samples(len(pairs), np.random.default_rng(seed)):
        candidate = umeyama(pairs.only(rows))
        if candidate is not None:
            error = float(np.median(_errors(pairs, candidate)))
            best, best_error = (candidate, error) if error < best_error else (best, best_error)
    agree = np.zeros(len(pairs), bool)
    for _ in range(_ROUNDS):
        if best is None:
            break
        agree, before = _near(pairs, best), agree
        if np.array_equal(agree, before):
            break
        best = umeyama(pairs.only(agree)) or best
    return agree


def _samples(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    if comb(count, _SAMPLE) <= _SAMPLES:
        return [np.array(rows) for rows in combinations(range(count), _SAMPLE)]
    return [rng.choice(count, _SAMPLE, replace=False) for _ in range(_SAMPLES)]


def _errors(pairs: Pairs, S_robot_map: Similarity) -> np.ndarray:
    """Return one error (N,) in metres of each pair."""
    positions, rotations = residuals(pairs, S_robot_map)
    arms = ARM * np.linalg.norm(rotations, axis=1) if pairs.oriented else 0.0
    return np.hypot(np.linalg.norm(positions, axis=1), arms)


def _near(pairs: Pairs, S_robot_map: Similarity) -> np.ndarray:
    """Return which pairs (N,) are not farther off than the others."""
    near = np.ones(len(pairs), bool)
    # The best of many samples lies nearer to few pairs than the truth does (Rousseeuw and Leroy, 1987).
    few = 1 + 5 / (len(pairs) - _SAMPLE)
    parts = residuals(pairs, S_robot_map) if pairs.oriented else residuals(pairs, S_robot_map)[:1]
    for part, least in zip(parts, _LEAST_SIGMAS, strict=False):
        lengths = np.linalg.norm(part, axis=1)
        near &= lengths <= _MAX_SIGMAS * max(least, few * float(np.median(lengths)) / _MEDIAN_LENGTH)
    return near
