"""Pictures of a localization: the photo beside renders, with what was matched."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gsfeatloc_ros.match.base import Matches

_GAP_WIDTH = 6  # pixels between pictures
_MAX_RINGS = 80  # more hide what they mark
_RING_RADIUS = 4  # pixels
_GAP_LEVEL = 255
# Drawn at 1/16 of a pixel, as cv2 counts with `shift=4`.
_SHIFT = 4


def side_by_side(images: Sequence[np.ndarray]) -> np.ndarray:
    """Put images (H, W, 3) uint8 of one height in a row, with a white gap between them."""
    gap = np.full((images[0].shape[0], _GAP_WIDTH, 3), _GAP_LEVEL, np.uint8)
    row = [part for image in images for part in (image, gap)]
    return np.hstack(row[:-1])


def mark_matches(photo: np.ndarray, render: np.ndarray, matches: Matches) -> tuple[np.ndarray, np.ndarray]:
    """Return the photo and a render, both (H, W, 3) uint8 RGB, with rings round the pixels of matches.

    The two ends of a match have the same colour. Of many matches an evenly spread choice is marked, the colours from
    left to right in the photo.
    """
    photo, render = photo.copy(), render.copy()
    if len(matches) == 0:
        return photo, render
    order = np.argsort(matches.a[:, 0], kind="stable")
    chosen = matches.select(order[np.linspace(0, len(order) - 1, min(len(order), _MAX_RINGS)).round().astype(int)])
    hues = np.linspace(0, 170, len(chosen)).astype(np.uint8)
    colours = cv2.cvtColor(np.column_stack([hues, np.full((len(hues), 2), 235, np.uint8)])[None], cv2.COLOR_HSV2RGB)[0]
    for picture, pixels in ((photo, chosen.a), (render, chosen.b)):
        for pixel, colour in zip(pixels, colours.tolist(), strict=True):
            centre = np.rint(pixel * (1 << _SHIFT)).astype(int).tolist()
            cv2.circle(picture, centre, _RING_RADIUS << _SHIFT, colour, 1, cv2.LINE_AA, _SHIFT)
    return photo, render
