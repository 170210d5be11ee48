"""Pictures of a localization: the photo beside renders, with lines between what was matched."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gsfeatloc_ros.match.base import Matches

_GAP = 6  # pixels between pictures
_MAX_LINES = 60  # more hide what they connect
_BACKGROUND = 255
# Drawn at 1/16 of a pixel, as cv2 counts with `shift=4`.
_SHIFT = 4


def side_by_side(images: Sequence[np.ndarray]) -> np.ndarray:
    """Images (H, W, 3) uint8 of one height in a row, with a white gap between them."""
    gap = np.full((images[0].shape[0], _GAP, 3), _BACKGROUND, np.uint8)
    row = [part for image in images for part in (image, gap)]
    return np.hstack(row[:-1])


def draw_matches(photo: np.ndarray, render: np.ndarray, matches: Matches) -> np.ndarray:
    """The photo beside a render (both (H, W, 3) uint8 RGB), with lines between the pixels of matches.

    Of many matches an evenly spread choice is drawn, the colours from left to right in the photo.
    """
    picture = side_by_side([photo, render])
    if len(matches) == 0:
        return picture
    order = np.argsort(matches.a[:, 0], kind="stable")
    chosen = matches.select(order[np.linspace(0, len(order) - 1, min(len(order), _MAX_LINES)).round().astype(int)])
    hues = np.linspace(0, 170, len(chosen)).astype(np.uint8)
    colours = cv2.cvtColor(np.column_stack([hues, np.full((len(hues), 2), 235, np.uint8)])[None], cv2.COLOR_HSV2RGB)[0]
    offset = np.array([photo.shape[1] + _GAP, 0])
    for start, end, colour in zip(chosen.a, chosen.b + offset, colours.tolist(), strict=True):
        ends = [tuple(np.rint(point * (1 << _SHIFT)).astype(int).tolist()) for point in (start, end)]
        cv2.line(picture, *ends, colour, 1, cv2.LINE_AA, _SHIFT)
        for end_point in ends:
            cv2.circle(picture, end_point, 3 << _SHIFT, colour, 1, cv2.LINE_AA, _SHIFT)
    return picture
