"""A picture of one localization: the photo beside the render, what was matched, and how it ended in words."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gsfeatloc_ros.localize.estimate import Estimate, Status, Trace
from gsfeatloc_ros.localize.protection import protection_level
from gsfeatloc_ros.match.base import Matches
from gsfeatloc_ros.ros_io.outcome import OutcomeStatus

# Pixels. Pictures are of one width, whatever the photo's, so that the words are as large in all of them.
_WIDTH = 1280
_MAX_PHOTO_HEIGHT = 960
_RING_RADIUS = 3
# Lines join one match in each of these cells of the photo, across and down: more would hide what they cross.
_LINE_CELLS = np.array([8, 6])
_LINE_OPACITY = 0.5
# Fraction bits of the coordinates of what is drawn, as cv2 counts them: 1/16 of a pixel.
_FRACTION_BITS = 4

# RGB.
_BACKGROUND, _LABEL, _TEXT = (24, 26, 30), (150, 158, 168), (238, 240, 243)
_GREEN, _AMBER, _RED = (36, 145, 60), (190, 120, 0), (200, 48, 42)
_COLOURS = {Status.LOCALIZED: _GREEN, Status.REJECTED: _AMBER, Status.FAILED: _RED}

# Sizes as cv2 counts them, then pixels.
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_TEXT_SIZE, _LABEL_SIZE = 0.5, 0.42
_MARGIN = 12
_STATUS_WIDTH = 104
_LINE_HEIGHT = 20
_ROW_HEIGHT = 42
# Fields take whole columns: numbers stay in their places from picture to picture. The evidence has two rows of them.
_COLUMN_WIDTH = 104
_COLUMN_GAP = 12
_EVIDENCE_ROWS = 3
# Room kept for the reason: nearly all pictures are of one height, as recorders of video want them.
_MIN_REASON_LINES = 2

# A name and what stands below it.
Field = tuple[str, str]


def draw(trace: Trace) -> np.ndarray:
    """Draw what the localizer made of a photo.

    The photo stands beside the last render that it was compared with. Inliers have a ring at both ends, in a colour
    that goes with their place in the photo, and some of them a line. Below are the status, the reason, the evidence,
    the protection level, milliseconds by stage and the pose's standard deviations (along and about the axes of the map
    frame; map units, degrees).

    Returns:
        (H, 1280, 3) uint8 RGB.
    """
    photo, estimate = trace.photo.image, trace.estimate
    left = _resized(photo, _size(photo))
    right = _black(left, "no render was matched")
    if trace.render is not None:
        right = _resized(trace.render.image(), _size(photo))
    pair = np.hstack([left, right])
    if trace.correspondences:
        # The render is of the photo's size where there are inliers.
        _draw_matches(pair, trace.correspondences, left.shape[1] / photo.shape[1])
    times = [(name, f"{ms:.0f} ms") for name, ms in estimate.milliseconds.items()]
    rows = [*_evidence_rows(estimate), times + _deviations(estimate)]
    return _with_words(pair, estimate.status.value, _COLOURS[estimate.status], estimate.reason, rows)


def draw_refused(photo: np.ndarray, reason: str) -> np.ndarray:
    """Draw a photo (H, W, 3) uint8 RGB of any size that was not tried, and why; of the same layout as `draw`."""
    left = _resized(photo, _size(photo))
    pair = np.hstack([left, _black(left, "not tried")])
    return _with_words(pair, OutcomeStatus.REFUSED.value, _RED, reason, [[]] * (_EVIDENCE_ROWS + 1))


def _size(photo: np.ndarray) -> tuple[int, int]:
    """Return the width and height of the photo in the picture."""
    height, width = photo.shape[:2]
    scale = min(_WIDTH / 2 / width, _MAX_PHOTO_HEIGHT / height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if image.shape[1::-1] == size:
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if image.shape[1] > size[0] else cv2.INTER_LINEAR)


def _black(photo: np.ndarray, words: str) -> np.ndarray:
    """Return a black picture of the photo's size with words in the middle."""
    picture = np.zeros_like(photo)
    height, width = photo.shape[:2]
    _write(picture, words, ((width - _text_width(words)) // 2, height // 2), _TEXT_SIZE, _LABEL)
    return picture


def _draw_matches(pair: np.ndarray, matches: Matches, scale: float) -> None:
    """Draw matches of two images into the two, resized by `scale`, side by side."""
    a, b = ((pixels + 0.5) * scale - 0.5 for pixels in (matches.a, matches.b))
    width, height = pair.shape[1] // 2, pair.shape[0]
    b = b + np.array([width, 0])
    hues = (170 * a[:, 0] / width).clip(0, 170)
    colours = _rgb(hues).tolist()
    a, b = (np.rint(pixels * (1 << _FRACTION_BITS)).astype(int) for pixels in (a, b))
    lines = pair.copy()
    for index in _one_a_cell(matches.a * scale / [width, height]):
        cv2.line(lines, a[index].tolist(), b[index].tolist(), colours[index], 1, cv2.LINE_AA, _FRACTION_BITS)
    cv2.addWeighted(lines, _LINE_OPACITY, pair, 1 - _LINE_OPACITY, 0, dst=pair)
    for pixels in (a, b):
        for centre, colour in zip(pixels.tolist(), colours, strict=True):
            cv2.circle(pair, centre, _RING_RADIUS << _FRACTION_BITS, colour, 1, cv2.LINE_AA, _FRACTION_BITS)


def _rgb(hues: np.ndarray) -> np.ndarray:
    """Return bright colours (N, 3) uint8 of hues (N,) in cv2's half degrees."""
    hsv = np.column_stack([hues, np.full(len(hues), 200.0), np.full(len(hues), 255.0)]).astype(np.uint8)
    return cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]


def _one_a_cell(places: np.ndarray) -> np.ndarray:
    """Return the index of the first in each of _LINE_CELLS of the places (N, 2), in shares of the photo."""
    columns, rows = np.clip(places * _LINE_CELLS, 0, _LINE_CELLS - 1).astype(int).T
    return np.unique(rows * _LINE_CELLS[0] + columns, return_index=True)[1]


def _evidence_rows(estimate: Estimate) -> list[list[Field]]:
    """Return the evidence and the protection level in rows that are full, as many as there always are."""
    fields = [
        (name.replace("_", " "), "-" if text == "nan" else text) for name, text in estimate.evidence.texts().items()
    ]
    if estimate.covariance is not None:
        level = protection_level(estimate.covariance)
        fields.append(("protection level", f"{level.radius:.2g}, {np.degrees(level.angle):.2g} deg"))
    rows: list[list[Field]] = [[]]
    for field in fields:
        if sum(map(_field_width, rows[-1])) + _field_width(field) > _WIDTH - 2 * _MARGIN + _COLUMN_GAP:
            rows.append([])
        rows[-1].append(field)
    return rows + [[]] * (_EVIDENCE_ROWS - len(rows))


def _field_width(field: Field) -> int:
    """Return the pixels that a field takes in its row, in whole columns."""
    name, value = field
    width = max(_text_width(name, _LABEL_SIZE), _text_width(value)) + _COLUMN_GAP
    return -(-width // _COLUMN_WIDTH) * _COLUMN_WIDTH


def _deviations(estimate: Estimate) -> list[Field]:
    if estimate.covariance is None:
        return []
    deviations = np.sqrt(np.diag(estimate.covariance))
    return [
        ("std dev along x, y, z", _numbers(deviations[:3])),
        ("about x, y, z, degrees", _numbers(np.degrees(deviations[3:]))),
    ]


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:#.2g}" for value in values)


def _with_words(
    pair: np.ndarray, status: str, colour: tuple[int, int, int], reason: str, rows: Sequence[Sequence[Field]]
) -> np.ndarray:
    """Put the status, the reason and rows of fields below the pictures."""
    reason_lines = _wrapped(reason, _WIDTH - _STATUS_WIDTH - 3 * _MARGIN)
    reason_height = max(_MIN_REASON_LINES, len(reason_lines)) * _LINE_HEIGHT
    height = 2 * _MARGIN + reason_height + len(rows) * _ROW_HEIGHT
    band = np.full((height, _WIDTH, 3), _BACKGROUND, np.uint8)

    cv2.rectangle(band, (_MARGIN, _MARGIN), (_MARGIN + _STATUS_WIDTH, _MARGIN + 26), colour, cv2.FILLED)
    middle = _MARGIN + (_STATUS_WIDTH - _text_width(status)) // 2
    _write(band, status, (middle, _MARGIN + 18), _TEXT_SIZE, _TEXT)
    for number, line in enumerate(reason_lines):
        _write(band, line, (2 * _MARGIN + _STATUS_WIDTH, _MARGIN + 18 + number * _LINE_HEIGHT), _TEXT_SIZE, _TEXT)
    for number, row in enumerate(rows):
        left, top = _MARGIN, _MARGIN + reason_height + number * _ROW_HEIGHT
        for name, value in row:
            _write(band, name, (left, top + 16), _LABEL_SIZE, _LABEL)
            _write(band, value, (left, top + 34), _TEXT_SIZE, _TEXT)
            left += _field_width((name, value))
    for caption, left in (("photo", 0), ("render", pair.shape[1] // 2)):
        cv2.rectangle(pair, (left, 0), (left + 2 * _MARGIN + _text_width(caption), 24), _BACKGROUND, cv2.FILLED)
        _write(pair, caption, (left + _MARGIN, 17), _TEXT_SIZE, _TEXT)
    pair = cv2.copyMakeBorder(pair, 0, 0, 0, _WIDTH - pair.shape[1], cv2.BORDER_CONSTANT, value=_BACKGROUND)
    return np.vstack([pair, band])


def _wrapped(text: str, width: int) -> list[str]:
    """Break a text into lines of whole words, at most `width` pixels wide; only a wider word is cut itself."""
    lines = [""]
    for word in text.split():
        if lines[-1] and _text_width(f"{lines[-1]} {word}") > width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".lstrip()
        while _text_width(lines[-1]) > width:
            fits = next(n for n in range(len(lines[-1]) - 1, 0, -1) if _text_width(lines[-1][:n]) <= width)
            lines[-1:] = [lines[-1][:fits], lines[-1][fits:]]
    return lines


def _text_width(text: str, size: float = _TEXT_SIZE) -> int:
    return cv2.getTextSize(text, _FONT, size, 1)[0][0]


def _write(picture: np.ndarray, text: str, left_bottom: tuple[int, int], size: float, colour: Sequence[int]) -> None:
    cv2.putText(picture, text, left_bottom, _FONT, size, colour, 1, cv2.LINE_AA)
