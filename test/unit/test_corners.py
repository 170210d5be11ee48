"""Corners, compared with OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import smooth_noise

from gsfeatloc_ros.match.corners import CORNER_BLOCK, MIN_CORNER_DISTANCE, MIN_CORNER_QUALITY, find_corners


def by_opencv(gray: np.ndarray, count: int, seen: np.ndarray | None = None) -> np.ndarray:
    corners = cv2.goodFeaturesToTrack(
        gray, count, MIN_CORNER_QUALITY, MIN_CORNER_DISTANCE, mask=seen, blockSize=CORNER_BLOCK
    )
    return np.empty((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(CORNER_BLOCK + 1, 150),
    width=st.integers(CORNER_BLOCK + 1, 150),
    count=st.integers(1, 300),
    masked=st.booleans(),
)
def test_they_are_opencvs_in_the_same_order(seed: int, height: int, width: int, count: int, masked: bool) -> None:
    gray = smooth_noise(seed, height, width)[..., 0]
    seen = (smooth_noise(seed + 1, height, width)[..., 0] > 120).astype(np.uint8) if masked else None
    ours, theirs = find_corners(gray, count, seen), by_opencv(gray, count, seen)
    assert ours.dtype == np.float32
    # What is equally strong but for a rounding may change places, and with it what lies near it.
    assert len(set(map(tuple, ours)) ^ set(map(tuple, theirs))) <= 0.02 * len(theirs)
    assert (ours[:20] == theirs[:20]).all(axis=1).mean() > 0.8 if len(theirs) else len(ours) == 0


def test_the_strongest_is_sought_where_the_mask_is() -> None:
    """Else what is seen would be weak beside what is not."""
    gray = np.full((60, 90), 100, np.uint8)
    gray[20:30, 10:20] = 255
    gray[20:30, 60:70] = 110
    seen = np.zeros_like(gray)
    seen[:, 45:] = 1
    assert len(find_corners(gray, 100)) == 4
    corners = find_corners(gray, 100, seen)
    assert len(corners) == 4
    assert corners[:, 0].min() > 50


def test_corners_that_are_all_equal_keep_their_distance() -> None:
    board = (np.kron(np.indices((30, 40)).sum(axis=0) % 2, np.ones((5, 5))) * 200).astype(np.uint8)
    corners = find_corners(board, 10_000)
    assert len(corners) > 300
    distances = np.linalg.norm(corners[:, None] - corners, axis=2) + 1e3 * np.eye(len(corners))
    assert distances.min() >= MIN_CORNER_DISTANCE
    np.testing.assert_array_equal(corners, by_opencv(board, 10_000))


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (2, 9), (40, CORNER_BLOCK), (50, 70)])
def test_where_there_is_nothing_to_see_there_are_none(size: tuple[int, int]) -> None:
    assert find_corners(np.full(size, 130, np.uint8), 10).shape == (0, 2)
    noise = np.random.default_rng(0).integers(256, size=size, dtype=np.uint8)
    assert find_corners(noise, 10, np.zeros(size, np.uint8)).shape == (0, 2)
