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


@pytest.mark.parametrize("neighbourhood", [2.0, 8.0, 12.0])
@pytest.mark.parametrize("size", [(120, 160), (107, 161)])
def test_it_is_that_of_gaussian_windows(size: tuple[int, int], neighbourhood: float) -> None:
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.normal(size=size).astype(np.float32), (0, 0), 2.0)
    gray = np.clip(128 + 300 * noise, 0, 255).astype(np.uint8)
    centred = gray - cv2.GaussianBlur(gray.astype(np.float32), (0, 0), neighbourhood)
    contrast = np.sqrt(cv2.GaussianBlur(centred**2, (0, 0), neighbourhood))
    expected = centred / np.maximum(contrast, 2.0)
    structure, found_contrast = local_structure(gray, neighbourhood, 2.0)
    assert structure.shape == size
    assert np.sqrt(np.mean((structure - expected) ** 2)) < 0.04 * np.sqrt(np.mean(expected**2))
    # On the border of the picture half a block is extrapolated.
    np.testing.assert_allclose(found_contrast, contrast, rtol=0.15)
    assert np.median(np.abs(found_contrast / contrast - 1)) < 0.01
