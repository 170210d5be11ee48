"""The local structure of brightness, held against Gaussian windows at full size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsfeatloc_ros.common.local_structure import local_structure


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (5, 3)])
def test_a_picture_of_one_shade_has_none(size: tuple[int, int]) -> None:
    structure, contrast = local_structure(np.full(size, 77, np.uint8), 12.0, 2.0)
    np.testing.assert_allclose(structure, np.zeros(size), atol=1e-3)
    np.testing.assert_allclose(contrast, np.zeros(size), atol=1e-3)


def noise(size: tuple[int, int]) -> np.ndarray:
    smooth = cv2.GaussianBlur(np.random.default_rng(0).normal(size=size).astype(np.float32), (0, 0), 2.0)
    return np.clip(128 + 300 * smooth, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("neighbourhood", [2.0, 8.0, 12.0])
@pytest.mark.parametrize("size", [(120, 160), (107, 161)])
def test_it_is_that_of_gaussian_windows(size: tuple[int, int], neighbourhood: float) -> None:
    gray = noise(size)
    centred = gray - cv2.GaussianBlur(gray.astype(np.float32), (0, 0), neighbourhood)
    contrast = np.sqrt(cv2.GaussianBlur(centred**2, (0, 0), neighbourhood))
    expected = centred / np.maximum(contrast, 2.0)
    structure, found_contrast = local_structure(gray, neighbourhood, 2.0)
    assert structure.shape == size
    assert np.sqrt(np.mean((structure - expected) ** 2)) < 0.04 * np.sqrt(np.mean(expected**2))
    # On the border of the picture half a block is extrapolated.
    np.testing.assert_allclose(found_contrast, contrast, rtol=0.15)
    assert np.median(np.abs(found_contrast / contrast - 1)) < 0.01


@pytest.mark.parametrize("size", [(120, 160), (107, 161)])
def test_what_does_not_count_changes_nothing_beside_it(size: tuple[int, int]) -> None:
    counted = np.ones(size, bool)
    counted[30:80, 40:110] = False
    gray = noise(size)
    structure, contrast = local_structure(gray, 12.0, 2.0, counted)
    for level in (0, 255):
        covered = np.where(counted, gray, np.uint8(level))
        np.testing.assert_array_equal(local_structure(covered, 12.0, 2.0, counted)[0], structure)
        # It would: the edge of the cover is the strongest structure that there is.
        assert np.abs(local_structure(covered, 12.0, 2.0)[0] - structure)[27, 40:110].mean() > 0.2
    assert (structure[~counted] == 0).all()
    # The mean and the deviation are those of what counts.
    shares = cv2.GaussianBlur(counted.astype(np.float32), (0, 0), 12.0)
    centred = counted * (gray - cv2.GaussianBlur((counted * gray).astype(np.float32), (0, 0), 12.0) / shares)
    expected = centred / np.sqrt(cv2.GaussianBlur(centred**2, (0, 0), 12.0) / shares)
    assert np.sqrt(np.mean((structure - expected)[counted] ** 2)) < 0.06 * np.sqrt(np.mean(expected[counted] ** 2))
    assert np.isfinite(contrast).all()


def test_where_all_counts_it_is_the_same() -> None:
    gray = noise((107, 161))
    everywhere = local_structure(gray, 12.0, 2.0)
    for a, b in zip(local_structure(gray, 12.0, 2.0, np.ones(gray.shape, bool)), everywhere, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_where_nothing_counts_there_is_none() -> None:
    for part in local_structure(noise((60, 80)), 12.0, 2.0, np.zeros((60, 80), bool)):
        np.testing.assert_array_equal(part, 0)
