"""Whether a pose may be believed: what the map predicts at the answer must match the photo."""

from __future__ import annotations

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.local_structure import local_structure
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.render.base import Render

# Corners may be off by this many times the median error, up to this many times the reprojection error allowed.
_BLUR_MEDIANS = 4.0
_BLUR_MOST = 2.0
# The photo is divided into this many cells across and down.
_CELLS = (8, 6)
# Photo and render are compared at this width: finer detail splats do not draw, and a mirror image has the coarser too.
_COMPARED_WIDTH = 320
# Standard deviation, in compared pixels, of the neighbourhood whose mean brightness and contrast are taken out.
_NEIGHBOURHOOD = 6.0
# Contrast (of 255) under which a neighbourhood says nothing: sky, a blank wall.
_MIN_CONTRAST = 2.0
# Pixels that are compared must be covered by the map, and seen by the lens.
_MIN_ALPHA = 0.9
_MIN_COVERED = 0.5
_MIN_COMPARED_SHARE = 0.05


def coverage(pixels: np.ndarray, width: int, height: int) -> float:
    """Share of the cells of a width x height image, in an 8 x 6 grid, in which at least one of `pixels` (M, 2) lies."""
    columns = np.clip((pixels[:, 0] + 0.5) * _CELLS[0] // width, 0, _CELLS[0] - 1).astype(int)
    rows = np.clip((pixels[:, 1] + 0.5) * _CELLS[1] // height, 0, _CELLS[1] - 1).astype(int)
    return len(np.unique(rows * _CELLS[0] + columns)) / (_CELLS[0] * _CELLS[1])


def agreeing_share(errors: np.ndarray, max_error: float) -> float:
    """Share of the tracked corners that agree with a pose, by their reprojection errors (M,) in pixels, M > 0.

    In a blurred photo all of them are less certain: they may be off by four times the median, up to twice `max_error`.
    """
    tolerance = np.clip(_BLUR_MEDIANS * np.median(errors), max_error, _BLUR_MOST * max_error)
    return float(np.mean(errors <= tolerance))


def agreement(photo: Photo, render: Render) -> float:
    """Correlation, in [-1, 1], of the photo with the map's render at the estimate.

    Both are reduced to their local structure, so that exposure, shading and colour balance do not count. NaN where too
    little of the photo has structure that the map covers.

    Args:
        photo: without distortion.
        render: of the same size, drawn with the same K at the estimate.
    """
    camera = photo.camera
    size = (_COMPARED_WIDTH, max(1, round(_COMPARED_WIDTH * camera.height / camera.width)))
    covered = photo.seen & (to_host(render.alpha) >= _MIN_ALPHA)
    covered = cv2.resize(covered.astype(np.float32), size, interpolation=cv2.INTER_AREA) > _MIN_COVERED
    (photo_structure, photo_contrast), (map_structure, map_contrast) = (
        local_structure(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), _NEIGHBOURHOOD, _MIN_CONTRAST)
        for gray in (photo.gray(), cv2.cvtColor(render.image(), cv2.COLOR_RGB2GRAY))
    )
    compared = covered & (np.maximum(photo_contrast, map_contrast) >= _MIN_CONTRAST)
    if compared.mean() < _MIN_COMPARED_SHARE:
        return float("nan")
    a, b = photo_structure[compared], map_structure[compared]
    norm = np.sqrt((a**2).sum() * (b**2).sum())
    return float((a * b).sum() / norm) if norm > 0 else float("nan")
