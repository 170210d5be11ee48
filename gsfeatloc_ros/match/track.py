"""Following the corners of a photo into renders of nearly the same view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import Array, to_host
from gsfeatloc_ros.common.local_structure import local_structure
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.match.base import Matches, Worth, all_of_them
from gsfeatloc_ros.match.corners import find_corners
from gsfeatloc_ros.match.flow import WINDOW, Pyramid, flow

# Most corners of a photo that are tracked into renders, and of a render into the photo.
MAX_CORNERS = 800
MAX_RENDER_CORNERS = 300
# The images that are compared: local structure (common/local_structure.py), its zero in the middle of a byte's range.
STRUCTURE_SIGMA = 12.0
STRUCTURE_MIN_CONTRAST = 8.0
STRUCTURE_GAIN = 40.0
# Of a corner that is followed to the render and back, in pixels.
MAX_RETURN_ERROR = 1.0


class CornerTracker:
    """Finds where the corners of a photo are in renders, by optical flow (match/flow.py).

    Where photo and render nearly coincide this is cheaper and more accurate than matching features: pixels are compared
    with pixels, all over the image. Both are reduced to their local structure first, as a map does not know today's
    light.

    Attributes:
        corners: (N, 2) float32 pixels of the photo.
    """

    def __init__(self, photo: Photo) -> None:
        gray = photo.gray()
        self._structure = _structure(gray)
        self.corners = find_corners(gray, MAX_CORNERS, seen_off_the_border(photo))
        self._last_render: _Seen | None = None

    def track(self, image: Array, worth: Worth = all_of_them) -> Matches:
        """Find the photo's corners that are `worth` it in a render (H, W, 3) uint8 RGB of its size.

        Corners that cannot be followed there and back are left out.
        """
        corners = self.corners[worth(self.corners)]
        return _matched(self._structure, self._see(image).structure, corners)

    def track_back(self, image: Array, worth: Worth = all_of_them) -> Matches:
        """Find the corners of a render (H, W, 3) uint8 RGB that are `worth` it in the photo.

        `a` of the matches are the photo's pixels.
        """
        render = self._see(image)
        corners = find_corners(render.gray, MAX_RENDER_CORNERS)
        return _matched(render.structure, self._structure, corners[worth(corners)]).swapped()

    def _see(self, image: Array) -> _Seen:
        """Return what a render looks like; that of the last one is kept, as it is tracked both ways."""
        if self._last_render is None or self._last_render.image is not image:
            gray = _gray(image)
            self._last_render = _Seen(image, gray, _structure(gray))
        return self._last_render


@dataclass(frozen=True, eq=False)
class _Seen:
    """A render, its brightness (H, W) uint8 and its local structure."""

    image: Array
    gray: np.ndarray
    structure: Pyramid


def seen_off_the_border(photo: Photo) -> np.ndarray:
    """Return where to look for corners, (H, W) uint8: the border of what the lens saw is no corner of the world."""
    return cv2.erode(photo.seen.astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8))


class Follower:
    """Finds where pixels of one picture are in another of nearly the same view."""

    def __init__(self, here: Array, there: Array) -> None:
        """Take two pictures (H, W, 3) uint8 RGB, on any device."""
        self._here, self._there = (_structure(_gray(image)) for image in (here, there))

    def follow(self, pixels: np.ndarray) -> np.ndarray:
        """Return where pixels (N, 2) of the one are in the other, (N, 2); NaN where they cannot be followed."""
        moved, kept = _there_and_back(self._here, self._there, pixels)
        return np.where(kept[:, None], moved, np.nan)


def _matched(here: Pyramid, there: Pyramid, corners: np.ndarray) -> Matches:
    """Match the corners (N, 2) of one structure with another."""
    if len(corners) == 0:
        return Matches.none()
    moved, kept = _there_and_back(here, there, corners)
    return Matches(corners[kept].astype(np.float64), moved[kept], np.ones(kept.sum()))


def _there_and_back(here: Pyramid, there: Pyramid, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where pixels (N, 2) of one structure are in another, (N, 2), and which return to where they were, (N,)."""
    moved, found = flow(here, there, pixels)
    back, found_back = flow(there, here, moved)
    returned = np.linalg.norm(back - pixels, axis=1) <= MAX_RETURN_ERROR
    return moved.astype(np.float64), found & found_back & returned


def _gray(image: Array) -> np.ndarray:
    """Return the brightness (H, W) uint8 of a picture (H, W, 3) uint8 RGB."""
    return cv2.cvtColor(to_host(image), cv2.COLOR_RGB2GRAY)


def _structure(gray: np.ndarray) -> Pyramid:
    """Return the local structure of brightness (H, W) uint8, as bytes."""
    structure, _ = local_structure(gray, STRUCTURE_SIGMA, STRUCTURE_MIN_CONTRAST)
    return Pyramid(cv2.addWeighted(structure, STRUCTURE_GAIN, structure, 0, 128, dtype=cv2.CV_8U))
