"""Views of a map with their features and what these are features of, compressed, to be searched."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.index.landmarks import Landmarks
from gsfeatloc_ros.match.base import Features, Matches
from gsfeatloc_ros.match.nearest import match_mutual

# Bytes of a compressed descriptor (product quantization; Jegou et al., 2011), and the values of each.
CODE_BYTES = 32
_VALUES = 256
# Lists that descriptors are kept in, about the square root of their number, and how many of them are searched.
_MAX_LISTS = 4096
_SEARCHED_LISTS = 12
# So many are found that are nearest to a feature; it votes for the views of the first of them.
_NEIGHBOURS = 32
_VOTES = 8
# Lowe's ratio in the matching with a view's few features.
_MAX_DISTANCE_RATIO = 0.9
# Descriptors that are decoded together.
_BATCH = 100_000
# Steps of a point's coordinate over the box of all points.
_STEPS = 65535
# faiss computes distances from more vectors than this by matrix products.
_MANY_VECTORS = 20


@dataclass(frozen=True, eq=False)
class Nearest:
    """The landmarks of an index that look most like each of the features of a picture, the nearest first.

    Attributes:
        pixels: (n, 2) of the features.
        distances: (n, k) float32, squared, of the descriptors; infinite where no more are near enough to be looked at.
        landmarks: (n, k) int64, their numbers; -1 there.
    """

    pixels: np.ndarray
    distances: np.ndarray
    landmarks: np.ndarray


@dataclass(frozen=True, eq=False)
class ViewIndex:
    """Views of a map.

    Attributes:
        poses: (N, 4, 4) float64, T_map_camera.
        counts: (N,) int32, number of landmarks that each view shows.
        seen: (F,) uint32, numbers of these, of one view after the other.
        points: (L, 3) uint16, the landmarks' points of the map, from `low` to `high`.
        codes: (L, CODE_BYTES) uint8, their descriptors, compressed.
        centroids: (CODE_BYTES, 256, D / CODE_BYTES) float32, what the bytes of a code stand for.
        low, high: (3,) float64, box of the points, map frame.
        look_alikes: (S, 4, 4) float64, motions of the map frame that carry places to others which look alike.
    """

    poses: np.ndarray
    counts: np.ndarray
    seen: np.ndarray
    points: np.ndarray
    codes: np.ndarray
    centroids: np.ndarray
    low: np.ndarray
    high: np.ndarray
    look_alikes: np.ndarray = field(default_factory=lambda: np.empty((0, 4, 4)))

    def __len__(self) -> int:
        return len(self.poses)

    def nearest(self, features: Features) -> Nearest:
        """Find what looks most like the features of a picture in all views: 32 landmarks, or as many as there are."""
        distances, numbers = self._search.search(features.descriptors, min(_NEIGHBOURS, len(self.codes)))
        return Nearest(to_host(features.keypoints), np.where(numbers >= 0, distances, np.inf), numbers)

    def rank(self, nearest: Nearest) -> np.ndarray:
        """Return the number of features of a photo (N,) float64 that speak for each view.

        A feature has a vote for each view that shows one of the eight landmarks nearest to it.
        """
        landmarks = nearest.landmarks[:, :_VOTES]
        feature, rank = np.nonzero(landmarks >= 0)
        like = csr_array(
            (np.ones(len(feature)), (feature, landmarks[feature, rank])), (len(landmarks), len(self.codes))
        )
        # One vote a view, of how many of its landmarks ever: repetitive texture must not outvote the rest.
        return np.asarray(((like @ self._shown) > 0).sum(axis=0), np.float64)

    def match(self, features: Features, view: int) -> tuple[Matches, np.ndarray]:
        """Match a photo's features with a view's; return the matches, and the points (M, 3) of the map at them.

        `b` of the matches is of no meaning: where in the view its features lie is not kept.
        """
        descriptors, points = self.contents(view)
        numbers = np.arange(len(points), dtype=np.float32)
        there = Features(np.column_stack([numbers, numbers]), descriptors, np.ones(len(numbers), np.float32))
        matches = match_mutual(features, there, max_ratio=_MAX_DISTANCE_RATIO)
        return matches, points[matches.b[:, 0].astype(int)]

    def contents(self, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the descriptors (m, D) float32 of the landmarks that a view shows, and their points (m, 3)."""
        shown = self._landmarks(view)
        return self._decoded(self.codes[shown]), self.points_of(shown)

    def points_of(self, landmarks: np.ndarray) -> np.ndarray:
        """Return the points (..., 3), map frame, of landmarks by their numbers (...)."""
        return self.low + self.points[landmarks] / _STEPS * (self.high - self.low)

    @cached_property
    def centres(self) -> np.ndarray:
        """What the views look at: the medians (N, 3) of their points, map frame; of a view without any its place."""
        return np.array(
            [
                np.median(self.points_of(self._landmarks(view)), axis=0) if self.counts[view] else pose[:3, 3]
                for view, pose in enumerate(self.poses)
            ]
        ).reshape(-1, 3)

    def prepare(self) -> None:
        """Make what the first search would make otherwise: seconds for a large index."""
        _ = self._search, self._shown, self.centres

    @staticmethod
    def compress(poses: np.ndarray, landmarks: Landmarks) -> ViewIndex:
        """Make an index of views by their poses (N, 4, 4), T_map_camera, and the landmarks that they show.

        Raises:
            ValueError: there is no landmark, or the length of descriptors is no multiple of CODE_BYTES.
        """
        import faiss

        every, where = landmarks.descriptors, landmarks.points
        if len(every) == 0:
            raise ValueError("the map shows nothing that could be recognized: no view of it has features")
        if every.shape[1] % CODE_BYTES:
            raise ValueError(f"descriptors of {every.shape[1]} numbers are no multiple of {CODE_BYTES}")
        quantizer = faiss.ProductQuantizer(every.shape[1], CODE_BYTES, round(math.log2(_VALUES)))
        # It warns of few on standard error; and fewer than its values it would refuse to train on.
        quantizer.cp.min_points_per_centroid = 1
        with _by_matrix_products():
            quantizer.train(np.resize(every, (max(len(every), _VALUES), every.shape[1])))
        low, high = where.min(axis=0), where.max(axis=0)
        steps = np.round((where - low) / np.maximum(high - low, np.finfo(float).tiny) * _STEPS)
        return ViewIndex(
            poses=np.asarray(poses, np.float64),
            counts=np.array([len(shown) for shown in landmarks.seen], np.int32),
            seen=np.concatenate(landmarks.seen).astype(np.uint32),
            points=steps.astype(np.uint16),
            codes=quantizer.compute_codes(every),
            centroids=faiss.vector_to_array(quantizer.centroids).reshape(CODE_BYTES, _VALUES, -1),
            low=low,
            high=high,
        )

    @cached_property
    def _first(self) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(self.counts, dtype=np.int64)])

    @cached_property
    def _shown(self) -> csr_array:
        """Which landmark (L) which view (N) shows."""
        view_of = np.repeat(np.arange(len(self)), self.counts)
        return csr_array((np.ones(len(self.seen)), (self.seen, view_of)), (len(self.codes), len(self)))

    def _landmarks(self, view: int) -> np.ndarray:
        """Return the numbers (m,) of the landmarks that a view shows."""
        return self.seen[self._first[view] : self._first[view + 1]]

    def _decoded(self, codes: np.ndarray) -> np.ndarray:
        """Return the descriptors (m, D) float32 of codes (m, CODE_BYTES), of unit length."""
        descriptors = self.centroids[np.arange(CODE_BYTES), codes].reshape(len(codes), -1)
        return descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9)

    @cached_property
    def _search(self) -> Any:
        """The descriptors in faiss's inverted lists, which need not all be looked at."""
        import faiss

        dimension = self.centroids.shape[0] * self.centroids.shape[2]
        lists = int(np.clip(math.sqrt(len(self.codes)), 1, _MAX_LISTS))
        coarse = faiss.IndexFlatL2(dimension)
        search = faiss.IndexIVFPQ(coarse, dimension, lists, CODE_BYTES, round(math.log2(_VALUES)))
        search.by_residual = False
        faiss.copy_array_to_vector(self.centroids.ravel(), search.pq.centroids)
        sample = self._decoded(self.codes[:: -(-len(self.codes) // (64 * lists))])
        clustering = faiss.Clustering(dimension, lists)
        clustering.min_points_per_centroid, clustering.niter = 1, 8
        clustering.train(sample, coarse)
        search.is_trained = True
        search.nprobe = _SEARCHED_LISTS
        for start in range(0, len(self.codes), _BATCH):
            search.add(self._decoded(self.codes[start : start + _BATCH]))
        return search


@contextmanager
def _by_matrix_products() -> Iterator[None]:
    """Let faiss compute the distances of k-means by matrix products.

    By itself it does so from some 30,000 vectors of four numbers on only, and takes 13 times as long for fewer.
    """
    import faiss

    usual = faiss.cvar.distance_compute_blas_threshold
    faiss.cvar.distance_compute_blas_threshold = _MANY_VECTORS
    try:
        yield
    finally:
        faiss.cvar.distance_compute_blas_threshold = usual
