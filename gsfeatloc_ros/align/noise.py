"""How noisy a drive is: what each pose is off by itself, and what a trajectory drifts by on its way.

The errors of a component are modelled as s^2 I + d^2 M + diag(v): s of each pose alone, a random walk of d a square
root of a metre with M_ij = min(l_i, l_j) of the ways l up to the poses, and the variances v that the answers state. s
and d have the greatest restricted likelihood (Patterson and Thompson, 1971), which is that of the residuals once what
was fitted is projected out: it is not biased by the fit. Beside it counts what trajectories are usually off by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

# Factors by which s and d may be smaller or larger than the residuals.
_SMALLEST, _LARGEST = 1e-3, 30.0
# Of the logarithms of s and d, before the drive: no trajectory is exact and none without drift, which a short one may
# not show.
_SPREADS = np.array([1.5, 1.0])
# A basis vector that is shorter than this share of the longest is none.
_RANK_TOLERANCE = 1e-7


@dataclass(frozen=True, eq=False)
class Noise:
    """The noise of one component, alike along three axes.

    Attributes:
        sigma: standard deviation of a pose by itself, in the unit of the component.
        drift: standard deviation of what comes up on a metre of the way; of four metres it is twice that.
        whitening: (N, N) W with W @ covariance @ W.T = I.
    """

    sigma: float
    drift: float
    whitening: np.ndarray


@dataclass(frozen=True)
class Usual:
    """The noise that may be expected of a component: the medians of s and d."""

    sigma: float
    drift: float


def estimate_noise(
    residuals: np.ndarray, jacobian: np.ndarray, travelled: np.ndarray, variances: np.ndarray, usual: Usual
) -> Noise:
    """Estimate the noise of a component.

    Args:
        residuals: (N, 3).
        jacobian: (N, 3, P) of what is fitted to them.
        travelled: (N,) metres up to each pose.
        variances: (N,) that are known.
        usual: noise of such components.
    """
    count = len(residuals)
    walk = np.minimum.outer(travelled, travelled)
    basis = _orthonormal(jacobian.reshape(3 * count, -1)).reshape(count, -1)
    size = max(float(np.sqrt(np.mean(residuals**2))), 1e-3 * usual.sigma)
    expected = np.log([usual.sigma, usual.drift])

    def covariance(logs: np.ndarray) -> np.ndarray:
        sigma, drift = np.exp(logs)
        return np.diag(variances + sigma**2) + drift**2 * walk

    def loss(logs: np.ndarray) -> float:
        """Return -2 log of the restricted likelihood, but for a constant."""
        factor = cho_factor(covariance(logs), lower=True)
        determinant = 3 * 2 * float(np.log(np.diag(factor[0])).sum())
        weighted = cho_solve(factor, np.hstack([residuals, basis]))
        of_residuals, of_basis = weighted[:, :3].reshape(-1), weighted[:, 3:].reshape(3 * count, -1)
        flat = basis.reshape(3 * count, -1)
        information = flat.T @ of_basis
        towards = of_basis.T @ residuals.reshape(-1)
        explained = towards @ np.linalg.solve(information, towards) if len(information) else 0.0
        likely = determinant + np.linalg.slogdet(information)[1] + residuals.reshape(-1) @ of_residuals - explained
        return float(likely + np.sum(((logs - expected) / _SPREADS) ** 2))

    smallest = _SMALLEST * np.array([max(size, usual.sigma), usual.drift])
    largest = _LARGEST * np.array([size, max(size, usual.drift)])
    bounds = np.log([smallest, largest]).T.tolist()
    best = minimize(loss, np.clip(expected, *np.transpose(bounds)), bounds=bounds, options={"ftol": 1e-6}).x
    factor = cholesky(covariance(best), lower=True)
    sigma, drift = np.exp(best).tolist()
    return Noise(sigma, drift, solve_triangular(factor, np.eye(count), lower=True))


def _orthonormal(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis (3 N, R) of what columns (3 N, P) span."""
    U, lengths, _ = np.linalg.svd(columns, full_matrices=False)
    return U[:, lengths > _RANK_TOLERANCE * lengths.max(initial=0.0)]
