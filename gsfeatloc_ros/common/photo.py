"""The photo as it is compared with renders: without distortion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera

# Photos of a shorter focal length, in pixels, are enlarged, if by at least this factor.
_MIN_FOCAL_LENGTH = 500.0
_MIN_ENLARGEMENT = 1.25


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo as a pinhole camera would have taken it, so that it compares with renders pixel by pixel.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        seen: (H, W) bool, where the lens saw something.
        camera: without distortion.
    """

    image: np.ndarray
    seen: np.ndarray
    camera: Camera

    @staticmethod
    def undistorted(image: np.ndarray, camera: Camera, max_width: int) -> Photo:
        """Undistort the image (H, W, 3) uint8 RGB that `camera` observed, at most `max_width` pixels wide.

        A small one is enlarged: what pixels are compared by is meant for the detail of usual photos.
        """
        image, camera = camera.limit(image, max_width)
        larger = camera.enlarged(_MIN_FOCAL_LENGTH, max_width)
        if larger.width >= _MIN_ENLARGEMENT * camera.width:
            image = cv2.resize(image, (larger.width, larger.height), interpolation=cv2.INTER_CUBIC)
            camera = larger
        return Photo(camera.undistort_image(image), camera.seen(), camera.pinhole())

    def limited(self, max_width: int) -> Photo:
        """Return the same at most `max_width` pixels wide."""
        image, camera = self.camera.limit(self.image, max_width)
        seen = cv2.resize(self.seen.astype(np.uint8), (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
        return Photo(image, seen.astype(bool), camera)

    def mirrored(self) -> Photo:
        """Return its mirror image, left for right. How the camera moved while it took the photo is left out."""
        K = self.camera.K.copy()
        K[0, 2] = self.camera.width - 1 - K[0, 2]
        image, seen = (np.ascontiguousarray(picture[:, ::-1]) for picture in (self.image, self.seen))
        return Photo(image, seen, replace(self.camera, K=K, readout=None))

    def zoomed(self, error: float) -> Photo:
        """Return it as if the focal length were longer by this share."""
        return replace(self, camera=self.camera.zoomed(error))

    def gray(self) -> np.ndarray:
        """Return the brightness (H, W) uint8."""
        return self._gray

    @cached_property
    def _gray(self) -> np.ndarray:
        return cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY)
