"""Pictures of fewer pixels, compared with OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsfeatloc_ros.common.shrink import shrunk
from gsfeatloc_ros.common.shrink_kernel import shrink


def picture(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(256, size=shape, dtype=np.uint8)


@settings(deadline=None, max_examples=200)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 90),
    width=st.integers(1, 90),
    share=st.tuples(st.floats(0.01, 1), st.floats(0.01, 1)),
    channels=st.sampled_from([(), (1,), (3,), (4,)]),
)
def test_they_are_opencvs(seed: int, height: int, width: int, share: tuple, channels: tuple) -> None:
    large = picture(seed, height, width, *channels)
    size = max(1, round(width * share[0])), max(1, round(height * share[1]))
    ours, theirs = shrunk(large, *size), cv2.resize(large, size, interpolation=cv2.INTER_AREA)
    off = np.abs(ours.astype(int) - theirs.reshape(ours.shape))
    assert ours.dtype == np.uint8
    # Near a half the order in which is added up decides.
    assert off.max() <= 1
    assert (off > 0).sum() <= max(3, 0.02 * off.size)


@pytest.mark.parametrize("size", [(640, 426), (291, 194), (799, 532), (33, 400)])
def test_of_a_photo_nearly_all_pixels_are_the_same(size: tuple[int, int]) -> None:
    photo = cv2.GaussianBlur(picture(0, 533, 800, 3), (0, 0), 2.0)
    ours, theirs = shrunk(photo, *size), cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
    assert (ours != theirs).mean() < 1e-3


def test_a_part_of_a_picture_is_shrunk_alike() -> None:
    """Its rows do not lie one behind the other."""
    whole = picture(1, 60, 80, 3)
    np.testing.assert_array_equal(shrunk(whole[5:55, 7:67], 41, 33), shrunk(whole[5:55, 7:67].copy(), 41, 33))


def test_pictures_of_all_kinds_are_shrunk_by_one_kernel() -> None:
    """Where another had to be compiled, the first image of a robot would wait for it."""
    photo = picture(3, 60, 80, 3)
    usual = shrunk(photo, 41, 33)
    photo.flags.writeable = False
    np.testing.assert_array_equal(shrunk(photo, 41, 33), usual)
    shrunk(photo[..., 0], 41, 33)
    assert len(shrink.signatures) == 1


def test_the_same_size_is_a_copy() -> None:
    photo = picture(2, 48, 64, 3)
    same = shrunk(photo, 64, 48)
    np.testing.assert_array_equal(same, photo)
    assert not np.shares_memory(same, photo)
