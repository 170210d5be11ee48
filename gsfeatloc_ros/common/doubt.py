"""Shares and correlations as numbers that may be added and averaged; never taken to be certain, which none is."""

from __future__ import annotations

import numpy as np

LEAST_DOUBT = 0.005
"""No share or correlation is taken to be nearer to its bounds than this."""


def logit(shares: np.ndarray | float) -> np.ndarray:
    """Return the logarithms of the odds of shares, in [0, 1]; NaN for NaN."""
    p = np.clip(shares, LEAST_DOUBT, 1 - LEAST_DOUBT)
    return np.log(p / (1 - p))


def fisher_z(correlations: np.ndarray | float) -> np.ndarray:
    """Return Fisher's z, the inverse hyperbolic tangent, of correlations, in [-1, 1]; NaN for NaN."""
    return np.arctanh(np.clip(correlations, LEAST_DOUBT - 1, 1 - LEAST_DOUBT))
