"""How far the replies of a localizer are from the truth of a simulated room, in numbers and in a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gsfeatloc_ros.client.bag_player import Reply
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import rotation_error_deg, translation_error
from gsfeatloc_ros.render import Renderer
from gsfeatloc_ros.simulate import SimulatedPhoto

# Degrees and metres up to which a photo counts as localized.
MAX_ROTATION_ERROR_DEG = 1.0
MAX_TRANSLATION_ERROR = 0.02

# Pixels, and grey values.
_CAPTION_HEIGHT, _MARGIN = 30, 4
_BACKGROUND, _INK = 24, 235


@dataclass(frozen=True, eq=False)
class Score:
    """A photo, the reply to it, and how far off the prior and the reply are.

    Attributes:
        photo: with its truth.
        reply: of the localizer.
        prior_error: degrees and metres.
        error: degrees and metres; NaN where the reply has no pose.
    """

    photo: SimulatedPhoto
    reply: Reply
    prior_error: tuple[float, float]
    error: tuple[float, float]

    @property
    def success(self) -> bool:
        """Whether the photo was localized, and rightly."""
        return self.error[0] <= MAX_ROTATION_ERROR_DEG and self.error[1] <= MAX_TRANSLATION_ERROR


def score(photo: SimulatedPhoto, reply: Reply) -> Score:
    """Compare a reply with the truth."""
    error = (float("nan"), float("nan"))
    if reply.T_map_camera is not None:
        error = pose_error(photo.T_map_camera, reply.T_map_camera)
    return Score(photo, reply, pose_error(photo.T_map_camera, photo.T_map_camera_prior), error)


def pose_error(truth: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
    """Return degrees and metres between two poses (4, 4)."""
    return rotation_error_deg(truth, pose), translation_error(truth, pose)


def draw_scores(scores: Sequence[Score], camera: Camera, renderer: Renderer, rows: int) -> np.ndarray:
    """Return a sheet (H, W, 3) uint8 RGB with `rows` photos: photo | render at the prior | render at the reply."""
    chosen = np.unique(np.linspace(0, len(scores) - 1, rows).round().astype(int))
    return np.vstack([_draw(number + 1, scores[number], camera, renderer) for number in chosen])


def _draw(number: int, score: Score, camera: Camera, renderer: Renderer) -> np.ndarray:
    photo, pose = score.photo, score.reply.T_map_camera
    # Renders are of a pinhole camera: without its distortion the photo can be compared with them.
    undistorted = camera.undistort_image(photo.image)
    at_prior = renderer.render(camera, photo.T_map_camera_prior).image()
    if pose is None:
        at_reply, words = np.zeros_like(undistorted), "no answer"
    else:
        at_reply = renderer.render(camera, pose).image()
        words = f"render at the estimate: {score.error[0]:.2f} deg, {100 * score.error[1]:.1f} cm off"
    prior_words = f"render at the prior: {score.prior_error[0]:.0f} deg, {score.prior_error[1]:.2f} m off"
    panels = [
        _captioned(undistorted, f"photo {number} (undistorted)"),
        _captioned(at_prior, prior_words),
        _captioned(at_reply, words),
    ]
    return np.hstack(panels)


def _captioned(image: np.ndarray, words: str) -> np.ndarray:
    """Return the image with a caption above and a margin around."""
    framed = cv2.copyMakeBorder(
        image, _CAPTION_HEIGHT, _MARGIN, _MARGIN, _MARGIN, cv2.BORDER_CONSTANT, value=(_BACKGROUND,) * 3
    )
    cv2.putText(framed, words, (8, 21), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (_INK,) * 3, 1, cv2.LINE_AA)
    return framed
