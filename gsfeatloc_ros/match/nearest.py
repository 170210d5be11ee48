"""Matching of descriptors by their nearest neighbours."""

from __future__ import annotations

import math

import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.match.base import Features, Matches


def match_mutual(
    a: Features, b: Features, min_similarity: float = -1.0, max_ratio: float = 1.0, max_turn: float = math.pi
) -> Matches:
    """Match features that are each other's nearest, by unit descriptors.

    Args:
        a, b: features of the two images, on one device.
        min_similarity: least cosine between two matched descriptors.
        max_ratio: Lowe's ratio test: the distance to the nearest descriptor of `b` must be less than this many times
            the distance to the second nearest.
        max_turn: radians by which two features may be turned against each other: others do not count, neither as the
            nearest nor as the second. With less than pi both have angles.

    Returns:
        The matches; their score is the cosine, cut to [0, 1].
    """
    if len(a) == 0 or len(b) == 0:
        return Matches.none()
    nearest = _nearest if isinstance(a.descriptors, np.ndarray) else _nearest_on_device
    best, second, mutual, *pixels = nearest(a, b, max_turn).T
    kept = (mutual > 0) & (best >= min_similarity)
    if max_ratio < 1.0:
        # Of unit vectors, the squared distance is 2 - 2 cosine.
        kept &= (1.0 - best) < max_ratio**2 * (1.0 - second)
    x_a, y_a, x_b, y_b = (coordinate[kept].astype(np.float64) for coordinate in pixels)
    scores = np.clip(best[kept].astype(np.float64), 0.0, 1.0)
    return Matches(np.column_stack([x_a, y_a]), np.column_stack([x_b, y_b]), scores)


def _nearest(a: Features, b: Features, max_turn: float) -> np.ndarray:
    """Find, for each of the N features of `a`, the nearest in `b`: (N, 7).

    Its similarity, that of the second nearest (-1 if there is none), whether the feature is the nearest's nearest, and
    the keypoints: x and y of the feature, x and y of the nearest.
    """
    similarity = to_host(a.descriptors) @ to_host(b.descriptors).T
    if max_turn < math.pi:
        similarity[(_directions(a) @ _directions(b).T) < math.cos(max_turn)] = -math.inf
    rows, nearest = np.arange(len(a)), similarity.argmax(axis=1)
    mutual = similarity.argmax(axis=0)[nearest] == rows
    best = similarity[rows, nearest]
    similarity[rows, nearest] = -1.0
    keypoints_a, keypoints_b = to_host(a.keypoints), to_host(b.keypoints)
    return np.column_stack([best, similarity.max(axis=1), mutual, keypoints_a, keypoints_b[nearest]])


def _directions(features: Features) -> np.ndarray:
    """Return the directions of features as unit vectors (N, 2)."""
    assert features.angles is not None
    angles = to_host(features.angles)
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _nearest_on_device(a: Features, b: Features, max_turn: float) -> np.ndarray:
    """Do the same with tensors, and in one copy, as each waits for the device."""
    import torch

    from gsfeatloc_ros.match.tensor import as_tensor

    similarity = as_tensor(a.descriptors) @ as_tensor(b.descriptors).T
    if max_turn < math.pi:
        assert a.angles is not None
        assert b.angles is not None
        turned = as_tensor(a.angles)[:, None] - as_tensor(b.angles)
        similarity.masked_fill_(turned.cos() < math.cos(max_turn), -math.inf)
    values, columns = similarity.topk(min(2, len(b)), dim=1)
    nearest = columns[:, 0]
    mutual = similarity.argmax(dim=0)[nearest] == torch.arange(len(a), device=nearest.device)
    values = torch.nn.functional.pad(values, (0, 2 - values.shape[1]), value=-1.0)
    keypoints_a, keypoints_b = as_tensor(a.keypoints), as_tensor(b.keypoints)
    return torch.column_stack([values, mutual, keypoints_a, keypoints_b[nearest]]).cpu().numpy()
