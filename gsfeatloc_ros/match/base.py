"""What every matcher takes and returns."""

from __future__ import annotations

from collections.abc import Callable, Sized
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias, TypeVar

import numpy as np

from gsfeatloc_ros.common.arrays import Array, to_host


@dataclass(frozen=True, eq=False)
class Features:
    """Local features of one image, on the device of the matcher that found them.

    Attributes:
        keypoints: (N, 2) float32 sub-pixel positions; the centre of the top-left pixel is (0, 0).
        descriptors: (N, D) float32, unit length.
        scores: (N,) float32, higher is better.
        angles: (N,) float32 radians by which the descriptors are turned in the image; None where they are not.
    """

    keypoints: Array
    descriptors: Array
    scores: Array
    angles: Array | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.keypoints)

    def on_host(self) -> Features:
        """Return the same with numpy arrays."""
        angles = None if self.angles is None else to_host(self.angles)
        return Features(to_host(self.keypoints), to_host(self.descriptors), to_host(self.scores), angles=angles)

    @staticmethod
    def none(dimension: int) -> Features:
        """Return no features, of descriptors of `dimension` numbers."""
        return Features(np.empty((0, 2), np.float32), np.empty((0, dimension), np.float32), np.empty(0, np.float32))


@dataclass(frozen=True, eq=False)
class Matches:
    """Pixels of two images that show the same thing; always on the host, where poses are solved.

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

    def swapped(self) -> Matches:
        """Return the matches from the second image to the first."""
        return Matches(self.b, self.a, self.scores)

    def select(self, kept: np.ndarray) -> Matches:
        """Return the matches that a mask (M,) or indices name."""
        return Matches(self.a[kept], self.b[kept], self.scores[kept])

    @staticmethod
    def none() -> Matches:
        """Return no matches."""
        return Matches(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))


# Tells of pixels (N, 2) of a picture which are worth to be found in another: (N,) bool.
Worth: TypeAlias = Callable[[np.ndarray], np.ndarray]


def all_of_them(pixels: np.ndarray) -> np.ndarray:
    """Return that all pixels (N, 2) are worth to be found."""
    return np.ones(len(pixels), bool)


class Tracker(Protocol):
    """Finds the corners of one photo in renders of nearly the same view.

    Attributes:
        corners: (N, 2) pixels of the photo.
    """

    @property
    def corners(self) -> np.ndarray: ...

    def track(self, image: Array, worth: Worth = all_of_them) -> Matches:
        """Find the photo's corners in a render (H, W, 3) uint8 RGB of its size; those that cannot be are left out.

        So may be, to save time, corners (N, 2) that are not `worth` it.
        """
        ...

    def track_back(self, image: Array, worth: Worth = all_of_them) -> Matches:
        """Find the corners of a render in the photo; `a` of the matches are still the photo's pixels."""
        ...


F = TypeVar("F", bound=Sized)


class Extractor(Protocol):
    """Finds local features."""

    def features(self, image: Array) -> Features:
        """Extract the features of an RGB image (H, W, 3) uint8; an image without any gives none."""
        ...


class Matcher(Protocol[F]):
    """Finds matches between two images in two steps, so that one image's features serve many comparisons.

    Images may lie on any device. What `features` returns is for the same matcher's `match`; others look at nothing but
    its length.

    Attributes:
        upright: whether images match only the same way up, within some 45 degrees; those of others do, within 60, if
            they are asked to.
    """

    @property
    def upright(self) -> bool: ...

    def features(self, image: Array) -> F:
        """Extract the features of an RGB image (H, W, 3) uint8; of an image without any the length is 0."""
        ...

    def match(self, a: F, b: F, same_way_up: bool = False) -> Matches:
        """Match the features of two images; empty features give no matches.

        Where the images are known to be the `same_way_up`, what is turned against that is not looked at.
        """
        ...
