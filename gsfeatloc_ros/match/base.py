"""What every matcher takes and returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

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


class Matcher(Protocol):
    """Finds matches between two images in two steps, so that one image's features serve many comparisons."""

    def features(self, image: np.ndarray) -> Features:
        """Extract the features of an RGB image (H, W, 3) uint8; an image without any gives empty arrays."""
        ...

    def match(self, a: Features, b: Features) -> Matches:
        """Match the features of two images; empty features give no matches."""
        ...
