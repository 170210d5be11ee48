"""Which one thing that may be wrong explains best how answers and odometry disagree, if any does."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.linalg import cholesky_banded
from scipy.linalg.lapack import dtbtrs

from gsfeatloc_ros.crosscheck.drive import CORRECTIONS, DELAY, LEVER, ROTATION, SCALE, Drive

# Shares of way and turn by which odometry may be off; which of them holds is fitted too.
_NOISES = np.geomspace(0.002, 0.4, 14)
# Steps of Gauss and Newton, and the share of its usual size by which a correction changes in the last one. All but the
# delay and large turns are linear.
_MAX_STEPS = 5
_CONVERGED = 1e-3
# A cause is named if it makes the disagreement e^10 times as likely as none does, and e^3 times as likely as any other,
# and is known to a fifth of itself.
_MIN_LOG_ODDS = 10.0
_MIN_LOG_ODDS_OTHERS = 3.0
_MIN_SIGMAS = 5.0


class Cause(Enum):
    """What may be wrong. The value is what people read."""

    SCALE = "scale"
    DELAY = "delay"
    LEVER = "lever"
    ROTATION = "rotation"

    @property
    def place(self) -> slice:
        """Where it is in a vector of corrections."""
        return _PLACES[self]

    @property
    def usual(self) -> float:
        """Standard deviation that it has before anything is known: a share, seconds, metres or radians."""
        return _USUAL[self]


_PLACES = {Cause.SCALE: SCALE, Cause.DELAY: DELAY, Cause.LEVER: LEVER, Cause.ROTATION: ROTATION}
_USUAL = {Cause.SCALE: 0.3, Cause.DELAY: 0.1, Cause.LEVER: 0.2, Cause.ROTATION: 0.1}
# Smaller ones are not named: odometry is off by as much, and answers are good enough.
_MIN_SIZES = {Cause.SCALE: 0.03, Cause.DELAY: 0.015, Cause.LEVER: 0.02, Cause.ROTATION: np.radians(0.7)}


@dataclass(frozen=True, eq=False)
class Fit:
    """How well a cause explains a drive.

    Attributes:
        cause: None for: all is right.
        value: (1,) or (3,) the correction, of the units and axes of Drive; (0,) without a cause.
        covariance: (n, n) of it; where the motion does not tell, it is as before anything was known.
        log_evidence: logarithm of the likelihood of the drive, with all values that the correction may have.
        noise: share of way and turn by which odometry is off.
    """

    cause: Cause | None
    value: np.ndarray
    covariance: np.ndarray
    log_evidence: float
    noise: float

    @property
    def size(self) -> float:
        """Of the correction, as far as the motion tells."""
        return float(np.linalg.norm(self.value[self.told]))

    @property
    def sigma(self) -> float:
        """Standard deviation of its size."""
        direction = np.where(self.told, self.value, 0.0) / max(self.size, 1e-12)
        return float(np.sqrt(direction @ self.covariance @ direction))

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviations of its components."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def told(self) -> np.ndarray:
        """Of which components the motion tells something."""
        return np.zeros(0, bool) if self.cause is None else self.sigmas < 0.5 * self.cause.usual


def explain(drive: Drive) -> Fit:
    """Return the cause that explains the drive, with its value; that all is right where none clearly does better.

    The causes are compared by Bayesian evidence in the manner of Laplace (MacKay, Information Theory, Inference, and
    Learning Algorithms, 2003, chapter 28): one that the motion does not tell of explains nothing, and is not chosen.
    """
    roots = [cholesky_banded(drive.covariance(noise), lower=True) for noise in _NOISES]
    right = _fit(drive, None, roots)
    fits = sorted((_fit(drive, cause, roots) for cause in Cause), key=lambda fit: fit.log_evidence)
    best, second = fits[-1], fits[-2]
    named = (
        best.cause is not None
        and best.log_evidence > right.log_evidence + _MIN_LOG_ODDS
        and best.log_evidence > second.log_evidence + _MIN_LOG_ODDS_OTHERS
        and best.size > max(_MIN_SIZES[best.cause], _MIN_SIGMAS * best.sigma)
    )
    return best if named else right


def _fit(drive: Drive, cause: Cause | None, roots: list[np.ndarray]) -> Fit:
    """Fit the correction of a cause; `roots` as of _solve, for each noise."""
    columns = np.arange(CORRECTIONS)[cause.place] if cause else np.arange(0)
    precision = np.eye(len(columns)) / (cause.usual**2 if cause else 1.0)
    value, likely = np.zeros(len(columns)), range(len(roots))
    for _ in range(_MAX_STEPS):
        corrections = np.zeros(CORRECTIONS)
        corrections[columns] = value
        system = np.column_stack([drive.residuals(corrections), drive.jacobian(corrections, columns)])
        fits = {noise: _solve(system, value, precision, roots[noise]) for noise in likely}
        best, before = max(fits, key=lambda noise: fits[noise][2]), value
        value, covariance, log_evidence = fits[best]
        likely = range(max(best - 1, 0), min(best + 2, len(roots)))
        if cause is None or np.abs(value - before).max() < _CONVERGED * cause.usual:
            break
    return Fit(cause, value, covariance, log_evidence, float(_NOISES[best]))


def _solve(
    system: np.ndarray, start: np.ndarray, precision: np.ndarray, root: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the most likely value (n,), its covariance (n, n), and the logarithm of the evidence but for a constant.

    Args:
        system: (m, 1 + n) residuals, and their derivatives, at `start`.
        start: (n,) value.
        precision: (n, n) inverse covariance of the value before anything is known; its mean is 0.
        root: band (diagonals, m) of the Cholesky factor of the residuals' covariance, the main diagonal first.
    """
    white, _ = dtbtrs(root, system, uplo="L")
    residuals, derivatives = white[:, 0] - white[:, 1:] @ start, white[:, 1:]
    information = derivatives.T @ derivatives + precision
    covariance = np.linalg.inv(information)
    value = -covariance @ derivatives.T @ residuals
    square = np.sum((residuals + derivatives @ value) ** 2) + value @ precision @ value
    spread = np.linalg.slogdet(information)[1] - np.linalg.slogdet(precision)[1]
    log_evidence = -0.5 * (square + spread) - np.log(root[0]).sum()
    return value, covariance, float(log_evidence)
