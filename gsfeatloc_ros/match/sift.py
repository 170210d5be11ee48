"""SIFT (Lowe, 2004) by OpenCV, with the RootSIFT descriptor (Arandjelovic and Zisserman, 2012)."""

from __future__ import annotations

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import Array, to_host
from gsfeatloc_ros.match.base import Features, Matches
from gsfeatloc_ros.match.nearest import match_mutual

# Renders are smoother than photos: SIFT's usual threshold of 0.04 leaves too few features in them.
MIN_CONTRAST = 0.01
# Of Lowe's test: distance to the nearest descriptor over that to the second nearest.
MAX_DISTANCE_RATIO = 0.85
# Where two images are the same way up, radians by which features that match may be turned: the camera by a third of it,
# and what is seen from the side more.
MAX_TURN = np.radians(60.0)


class Sift:
    """SIFT features, matched by mutual nearest neighbours and the ratio test. Needs no weights."""

    upright = False

    def __init__(self, max_features: int) -> None:
        # Precise upscaling: without it keypoints are a quarter of a pixel off.
        self._sift = cv2.SIFT.create(
            nfeatures=max_features, contrastThreshold=MIN_CONTRAST, enable_precise_upscale=True
        )

    def features(self, image: Array) -> Features:
        """Extract the features of an RGB image (H, W, 3) uint8."""
        keypoints, descriptors = self._sift.detectAndCompute(cv2.cvtColor(to_host(image), cv2.COLOR_RGB2GRAY), None)
        if not keypoints:
            return Features.none(128)
        descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
        return Features(
            np.asarray(cv2.KeyPoint.convert(keypoints)),
            descriptors,
            np.array([k.response for k in keypoints], dtype=np.float32),
            angles=np.radians(np.array([k.angle for k in keypoints], dtype=np.float32)),
        )

    def match(self, a: Features, b: Features, same_way_up: bool = False) -> Matches:
        """Match the features of two images, of two that are the `same_way_up` those that are turned alike."""
        return match_mutual(a, b, max_ratio=MAX_DISTANCE_RATIO, max_turn=MAX_TURN if same_way_up else np.pi)
