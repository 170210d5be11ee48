"""Matching of descriptors by their nearest neighbours."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.match.base import Features, Matches


def match_mutual(a: Features, b: Features, min_similarity: float = -1.0, max_ratio: float = 1.0) -> Matches:
    """Match features that are each other's nearest, by unit descriptors.

    Args:
        a, b: features of the two images.
        min_similarity: least cosine between two matched descriptors.
        max_ratio: Lowe's ratio test: the distance to the nearest descriptor of `b` must be less than this many times
            the distance to the second nearest.

    Returns:
        Matches whose score is the cosine, cut to [0, 1].
    """
    if len(a) == 0 or len(b) == 0:
        return Matches.none()
    similarity = a.descriptors @ b.descriptors.T
    nearest = similarity.argmax(axis=1)
    rows = np.arange(len(a))
    best = similarity[rows, nearest]
    kept = (similarity.argmax(axis=0)[nearest] == rows) & (best >= min_similarity)
    if max_ratio < 1.0:
        similarity[rows, nearest] = -1.0
        second = similarity.max(axis=1)
        # Of unit vectors, the squared distance is 2 - 2 cosine.
        kept &= (1.0 - best) < max_ratio**2 * (1.0 - second)
    return Matches.from_indices(a, b, rows[kept], nearest[kept], np.clip(best[kept], 0.0, 1.0))
