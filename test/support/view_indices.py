"""Indices of made-up views, and photos of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.index import ViewIndex
from gsfeatloc_ros.index.landmarks import Landmarks
from gsfeatloc_ros.match import Features


class MadeUpIndex(NamedTuple):
    """An index, and what it was made of: each view's descriptors (m, D) and points (m, 3)."""

    index: ViewIndex
    descriptors: list[np.ndarray]
    points: list[np.ndarray]


def unit_vectors(rng: np.random.Generator, count: int, dimension: int) -> np.ndarray:
    """Random descriptors (count, dimension) float32."""
    vectors = rng.normal(size=(count, dimension)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def made_up_index(views: int, features: int, dimension: int, seed: int = 0) -> MadeUpIndex:
    """An index of views that have nothing in common, of so many features each."""
    rng = np.random.default_rng(seed)
    poses = np.array([make_pose(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(views)])
    descriptors = [unit_vectors(rng, features, dimension) for _ in range(views)]
    points = [rng.uniform([-5, -4, 0], [5, 4, 3], (features, 3)) for _ in range(views)]
    return MadeUpIndex(ViewIndex.compress(poses, landmarks_of(descriptors, points)), descriptors, points)


def landmarks_of(descriptors: list[np.ndarray], points: list[np.ndarray]) -> Landmarks:
    """Landmarks with the descriptors (m, D) and points (m, 3) of each view, which no other view shows."""
    counts = [len(view) for view in points]
    seen = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
    return Landmarks(np.concatenate(descriptors), np.concatenate(points), seen)


def photo_of(descriptors: np.ndarray, noise: float = 0.0) -> Features:
    """Features that look like others (m, D), but for noise of this length; x of a keypoint is its number."""
    rng = np.random.default_rng(0)
    seen = descriptors + noise * unit_vectors(rng, *descriptors.shape)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    numbers = np.arange(len(seen), dtype=np.float32)
    return Features(np.column_stack([numbers, numbers]), seen.astype(np.float32), np.ones(len(seen), np.float32))
