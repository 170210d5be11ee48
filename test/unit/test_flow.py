"""Optical flow, compared with OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import smooth_noise

from gsfeatloc_ros.match.flow import MAX_LEVEL, WINDOW, Pyramid, flow


def by_opencv(here: np.ndarray, there: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.03)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        here, there, pixels, None, winSize=(WINDOW, WINDOW), maxLevel=MAX_LEVEL, criteria=criteria
    )
    return moved, found[:, 0] == 1


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 1000), dx=st.floats(-12, 12), dy=st.floats(-12, 12), turn=st.floats(-3, 3))
def test_it_finds_what_opencv_finds(seed: int, dx: float, dy: float, turn: float) -> None:
    """Of corners that the other picture shows too; what is not there one finds here, one there.

    Windows that stick out are weighed a little differently. They are many in a small picture.
    """
    width, height = 320, 240
    here = smooth_noise(seed, height, width)[..., 0]
    motion = cv2.getRotationMatrix2D((width / 2, height / 2), turn, 1.0)
    motion[:, 2] += [dx, dy]
    there = cv2.warpAffine(here, motion, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    last = np.array([width - 1, height - 1])
    pixels = np.random.default_rng(seed).uniform([0, 0], last, (200, 2)).astype(np.float32)
    truth = pixels @ motion[:, :2].T + motion[:, 2]
    seen = ((truth >= 0) & (truth <= last)).all(axis=1)
    pixels, truth = pixels[seen], truth[seen]
    moved, found = flow(Pyramid(here), Pyramid(there), pixels)
    oracle, found_by_oracle = by_opencv(here, there, pixels)
    assert (found == found_by_oracle).mean() > 0.97
    off = np.linalg.norm(moved - oracle, axis=1)
    assert np.median(off) < 0.01
    assert (off < 0.1).mean() > 0.85
    right, right_by_oracle = ((np.linalg.norm(each - truth, axis=1) < 0.5).mean() for each in (moved, oracle))
    assert right > right_by_oracle - 0.02


@settings(deadline=None, max_examples=50)
@given(
    seed=st.integers(0, 100),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    x=st.floats(-1e6, 1e6),
    y=st.floats(-1e6, 1e6),
)
def test_pictures_of_any_size_and_pixels_anywhere_do_no_harm(
    seed: int, height: int, width: int, x: float, y: float
) -> None:
    rng = np.random.default_rng(seed)
    here, there = (Pyramid(rng.integers(0, 256, (height, width), np.uint8)) for _ in range(2))
    pixels = np.array([[x, y], [0, 0], [width - 1, height - 1]])
    moved, found = flow(here, there, pixels)
    assert moved.shape == (3, 2)
    assert np.isfinite(moved).all()
    assert not found[0] or (-WINDOW <= x <= width + WINDOW and -WINDOW <= y <= height + WINDOW)


def test_nothing_is_followed_in_a_blank_picture() -> None:
    blank, textured = Pyramid(np.full((120, 160), 128, np.uint8)), Pyramid(smooth_noise(0)[..., 0])
    pixels = np.array([[50.0, 40.0], [80.0, 60.0]])
    assert not flow(blank, textured, pixels)[1].any()


def test_no_pixels_are_found_nowhere() -> None:
    picture = Pyramid(smooth_noise(0)[..., 0])
    moved, found = flow(picture, picture, np.empty((0, 2)))
    assert moved.shape == (0, 2)
    assert found.shape == (0,)


def test_pictures_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="different sizes"):
        flow(Pyramid(np.zeros((30, 40), np.uint8)), Pyramid(np.zeros((30, 41), np.uint8)), np.zeros((1, 2)))
