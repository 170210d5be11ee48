"""Whether a pose may be believed: what the map predicts at the answer must match the photo."""

from __future__ import annotations

import cv2
import numpy as np

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.render.base import Render

# The photo is divided into this many cells across and down.
_CELLS = (8, 6)
# Photo and render are compared at this width: finer detail splats do not draw, and a mirror image has the coarser too.
_COMPARED_WIDTH = 320
# Standard deviation, in compared pixels, of the neighbourhood whose mean brightness and contrast are taken out.
_NEIGHBOURHOOD = 6.0
# Contrast (of 255) under which a neighbourhood says nothing: sky, a blank wall.
_MIN_CONTRAST = 2.0
# Pixels that are compared must be covered by the map.
_MIN_ALPHA = 0.9
_MIN_COMPARED_SHARE = 0.05


def coverage(pixels: np.ndarray, width: int, height: int) -> float:
    """Share of the cells of a width x height image, in an 8 x 6 grid, in which at least one of `pixels` (M, 2) lies."""
    columns = np.clip((pixels[:, 0] + 0.5) * _CELLS[0] // width, 0, _CELLS[0] - 1).astype(int)
    rows = np.clip((pixels[:, 1] + 0.5) * _CELLS[1] // height, 0, _CELLS[1] - 1).astype(int)
    return len(np.unique(rows * _CELLS[0] + columns)) / (_CELLS[0] * _CELLS[1])


def agreement(image: np.ndarray, camera: Camera, render: Render) -> float:
    """Correlation, in [-1, 1], of the photo with the map's render at the estimate.

    Both are reduced to the local structure of the brightness, each neighbourhood normalised by its mean and contrast,
    so that exposure, shading and colour balance do not count. NaN where too little of the photo has structure that the
    map covers.

    Args:
        image: (H, W, 3) uint8 RGB, as observed by `camera` (distorted).
        camera: of the photo.
        render: (H, W), drawn with the same K at the estimate.
    """
    image = camera.undistort_image(image)
    size = (_COMPARED_WIDTH, max(1, round(_COMPARED_WIDTH * camera.height / camera.width)))
    covered = cv2.resize(render.alpha, size, interpolation=cv2.INTER_AREA) >= _MIN_ALPHA
    (photo, photo_contrast), (map_, map_contrast) = (
        _local_structure(cv2.resize(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA))
        for i in (image, render.image())
    )
    compared = covered & (np.maximum(photo_contrast, map_contrast) >= _MIN_CONTRAST)
    if compared.mean() < _MIN_COMPARED_SHARE:
        return float("nan")
    photo, map_ = photo[compared], map_[compared]
    norm = np.sqrt((photo**2).sum() * (map_**2).sum())
    return float((photo * map_).sum() / norm) if norm > 0 else float("nan")


def _local_structure(gray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brightness (H, W) less its local mean over its local deviation, and that deviation."""
    gray = gray.astype(np.float32)
    centred = gray - cv2.GaussianBlur(gray, (0, 0), _NEIGHBOURHOOD)
    contrast = np.sqrt(cv2.GaussianBlur(centred**2, (0, 0), _NEIGHBOURHOOD))
    return centred / np.maximum(contrast, _MIN_CONTRAST), contrast
