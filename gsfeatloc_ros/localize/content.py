"""Whether a photo shows enough to be localized at all: what a covered lens sees costs no search."""

from __future__ import annotations

import cv2
import numpy as np

from gsfeatloc_ros.localize.evidence import coverage
from gsfeatloc_ros.localize.query import Query

# With fewer features, a photo is looked for nowhere.
MIN_FEATURES = 8
# Brightness that differs by no more, of 255, is one shade; photos have up to 9 % of their pixels around their median.
_SHADE = 3
_MAX_OF_ONE_SHADE = 0.95
_WHY = "is the lens covered, or is it too dark, too bright or out of focus?"


def too_little(query: Query) -> str:
    """Return why no pose can be an answer for a photo, whatever is found; empty where one can.

    Inliers are among the photo's corners, so that these must be as many and as far spread as an answer's.
    """
    limits, corners, camera = query.components.options.limits, query.tracker.corners, query.photo.camera
    share = coverage(corners, camera.width, camera.height)
    if len(corners) < limits.min_inliers or share < limits.min_coverage:
        needed = f"at least {limits.min_inliers} in {limits.min_coverage:.0%} needed"
        return f"{len(corners)} corners in {share:.0%} of the photo ({needed}): {_WHY}"
    one_shade = _share_of_one_shade(query.photo.gray(), query.photo.seen)
    return f"{one_shade:.1%} of the photo is of one shade: {_WHY}" if one_shade >= _MAX_OF_ONE_SHADE else ""


def too_few_features(small: Query) -> str:
    """Return why it is no use to look for a photo, as it is searched, by its features; empty where it is."""
    features = len(small.features)
    return f"{features} features in the photo: {_WHY}" if features < MIN_FEATURES else ""


def _share_of_one_shade(gray: np.ndarray, seen: np.ndarray) -> float:
    """Return the share of the brightnesses (H, W) uint8, where they are seen (H, W) bool, that are about their median.

    By their counts, as all photos pay.
    """
    counts = cv2.calcHist([gray], [0], seen.view(np.uint8), [256], [0, 256]).ravel().astype(np.int64)
    up_to = np.cumsum(counts)
    median = 0.5 * np.searchsorted(up_to, [(up_to[-1] - 1) // 2, up_to[-1] // 2], side="right").sum()
    return float(counts[np.abs(np.arange(256) - median) <= _SHADE].sum() / up_to[-1])
