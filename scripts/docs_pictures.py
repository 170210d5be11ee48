"""Draw the pictures of docs/how-it-works.md, from the simulated room: python scripts/docs_pictures.py"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from gsfeatloc_ros import Camera, Localizer, LocalizerOptions, create_matcher, create_renderer
from gsfeatloc_ros.index import build_index
from gsfeatloc_ros.index.options import IndexOptions
from gsfeatloc_ros.match.base import Matcher
from gsfeatloc_ros.render.base import Renderer
from gsfeatloc_ros.ros_io.debug_picture import draw
from gsfeatloc_ros.simulate import Room, SimulatedPhoto, cover, simulate_photos

_FOLDER = Path(__file__).resolve().parents[1] / "docs"
_K = np.array([[500.0, 0.0, 322.0], [0.0, 502.0, 236.0], [0.0, 0.0, 1.0]])
_CAMERA = Camera(640, 480, _K, np.array([-0.28, 0.09, 0.0008, -0.0005, 0.0]))
_VIEW_CAMERA = Camera(320, 240, np.array([[250.0, 0.0, 160.0], [0.0, 250.0, 120.0], [0.0, 0.0, 1.0]]))
_VIEWS, _COLUMNS, _ROWS = 60, 4, 3
# The photo of the walk that is shown, and about how many of its matches: more would hide it.
_PHOTO, _LINES = 6, 40


def main() -> None:
    """Draw all of them."""
    room = Room(seed=0)
    room_map = cover(room)
    renderer, matcher = create_renderer(room_map), create_matcher("sift")
    photo = simulate_photos(room, _CAMERA, _PHOTO + 1)[_PHOTO]
    _save("how-matches.jpg", _matches(photo, renderer, matcher))

    options = LocalizerOptions(prior_rotation=20.0, prior_translation=0.7)
    trace = Localizer(renderer, matcher, options).trace(photo.image, _CAMERA, photo.T_map_camera_prior)
    print(trace.estimate.status.value, trace.estimate.reason)
    _save("how-answer.jpg", draw(trace))

    index = build_index(renderer, matcher, IndexOptions(views=_VIEWS))
    shown = np.linspace(0, len(index) - 1, _COLUMNS * _ROWS).round().astype(int)
    views = [renderer.render(_VIEW_CAMERA, index.poses[view]).image() for view in shown]
    rows = [np.hstack(views[row * _COLUMNS : (row + 1) * _COLUMNS]) for row in range(_ROWS)]
    _save("how-index.jpg", np.vstack(rows))


def _matches(photo: SimulatedPhoto, renderer: Renderer, matcher: Matcher) -> np.ndarray:
    """Return the photo beside the render at the prior, some features that were matched joined by lines."""
    left = _CAMERA.undistort_image(photo.image)
    right = renderer.render(_CAMERA, photo.T_map_camera_prior).image()
    matches = matcher.match(matcher.features(left), matcher.features(right))
    picture = np.hstack([left, right])
    chosen = matches.select(np.arange(0, len(matches), max(1, len(matches) // _LINES)))
    beside = chosen.b + np.array([left.shape[1], 0])
    for number, (a, b) in enumerate(zip(chosen.a, beside, strict=True)):
        hue = np.uint8([[[number * 37 % 180, 200, 255]]])
        colour = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].tolist()
        for end in (a, b):
            cv2.circle(picture, end.round().astype(int).tolist(), 4, colour, 1, cv2.LINE_AA)
        cv2.line(picture, a.round().astype(int).tolist(), b.round().astype(int).tolist(), colour, 1, cv2.LINE_AA)
    return picture


def _save(name: str, picture: np.ndarray) -> None:
    cv2.imwrite(str(_FOLDER / name), picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    print(f"{_FOLDER / name}: {picture.shape[1]}x{picture.shape[0]}")


if __name__ == "__main__":
    main()
