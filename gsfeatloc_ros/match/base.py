"""What every matcher takes and returns."""

from __future__ import annotations

from collections.abc import Sized
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np


@dataclass(frozen=True, eq=False)
class Features:
    """Local features of one image.

    Attributes:
        keypoints: (N, 2) float32 sub-pixel positions; the centre of the top-left pixel is (0, 0).
        descriptors: (N, D) float32, unit length.
        scores: (N,) float32, higher is better.
    """

    keypoints: np.ndarray
    descriptors: np.ndarray
    scores: np.ndarray

    def __len__(self) -> int:
        return len(self.keypoints)

    @staticmethod
    def none(dimension: int) -> Features:
        """No features, of descriptors of `dimension` numbers."""
        return Features(np.empty((0, 2), np.float32), np.empty((0, dimension), np.float32), np.empty(0, np.float32))


@dataclass(frozen=True, eq=False)
class Matches:
    """Pixels of two images that show the same thing.

    Attributes:
        a: (M, 2) float64 pixels in the first image.
        b: (M, 2) float64 pixels in the second image.
        scores: (M,) float64 in [0, 1], higher is better.
    """

    a: np.ndarray
    b: np.ndarray
    scores: np.ndarray

    def __len__(self) -> int:
        return len(self.a)

    def select(self, kept: np.ndarray) -> Matches:
        """The matches that a mask (M,) or indices name."""
        return Matches(self.a[kept], self.b[kept], self.scores[kept])

    @staticmethod
    def from_indices(a: Features, b: Features, index_a: np.ndarray, index_b: np.ndarray, scores: np.ndarray) -> Matches:
        """Matches between the features `index_a` (M,) of `a` and `index_b` (M,) of `b`."""
        return Matches(
            a.keypoints[index_a].astype(np.float64),
            b.keypoints[index_b].astype(np.float64),
            np.asarray(scores, dtype=np.float64),
        )

    @staticmethod
    def none() -> Matches:
        """No matches."""
        return Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))


F = TypeVar("F", bound=Sized)


class Extractor(Protocol):
    """Finds local features."""

    def features(self, image: np.ndarray) -> Features:
        """Extract the features of an RGB image (H, W, 3) uint8; an image without any gives empty arrays."""
        ...


class Matcher(Protocol[F]):
    """Finds matches between two images in two steps, so that one image's features serve many comparisons.

    What `features` returns is for the same matcher's `match`; others look at nothing but its length.
    """

    def features(self, image: np.ndarray) -> F:
        """Extract the features of an RGB image (H, W, 3) uint8; of an image without any the length is 0."""
        ...

    def match(self, a: F, b: F) -> Matches:
        """Match the features of two images; empty features give no matches."""
        ...
