"""SIFT in torch, beside OpenCV's and beside the truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import rectangles, shifted
from stand_in.gpu import simulated_gpu

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.match.base import Features
from gsfeatloc_ros.match.sift import Sift
from gsfeatloc_ros.match.sift_gpu import GpuSift

HEIGHT, WIDTH = 213, 317


def on_cpu(max_features: int = 2048) -> GpuSift:
    return GpuSift(max_features, "cpu")


def on_host(features: Features) -> Features:
    return Features(*map(to_host, (features.keypoints, features.descriptors, features.scores)))


def together(a: Features, b: Features) -> tuple[np.ndarray, np.ndarray]:
    """For each feature of `a`, the distance to the nearest of `b` in pixels, and how like one within half a pixel is.

    The likeness (cosine) is that of the likest, as there may be one for each orientation; NaN where none is near.
    """
    distance = np.linalg.norm(a.keypoints[:, None] - b.keypoints, axis=2)
    near = distance < 0.5
    cosine = np.where(near, a.descriptors @ b.descriptors.T, -1.0).max(axis=1)
    return distance.min(axis=1), np.where(near.any(axis=1), cosine, np.nan)


@pytest.mark.parametrize("size", [(1, 1), (1, 50), (5, 5), (6, 6), (8, 8), (8, 90), (31, 33), (HEIGHT, WIDTH)])
@pytest.mark.parametrize("value", [0, 128, 255])
def test_pictures_of_one_colour_have_no_features(size: tuple[int, int], value: int) -> None:
    sift = on_cpu()
    features = sift.features(np.full((*size, 3), value, np.uint8))
    assert len(features) == 0
    assert features.keypoints.shape == (0, 2)
    assert features.descriptors.shape == (0, 128)
    assert features.scores.shape == (0,)
    something = sift.features(rectangles(64, 64))
    for a, b in ((features, features), (features, something), (something, features)):
        assert len(sift.match(a, b)) == 0


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_noise_of_any_size_does_no_harm(height: int, width: int, seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    features = on_host(on_cpu(30).features(image))
    assert len(features) <= 30
    assert ((features.keypoints >= 0) & (features.keypoints <= [width - 1, height - 1])).all()
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-5)
    assert (features.scores > 0).all()


def test_the_strongest_are_kept_and_come_first() -> None:
    image = rectangles(HEIGHT, WIDTH)
    everything, few = on_cpu().features(image), on_cpu(50).features(image)
    assert len(everything) > 300
    assert len(few) == 50
    assert (few.scores.diff() <= 0).all()
    torch.testing.assert_close(few.scores, everything.scores[:50])


# OpenCV's


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (96, 128), (60, 400)])
def test_features_are_opencvs(size: tuple[int, int]) -> None:
    image = rectangles(*size)
    ours, theirs = on_host(on_cpu().features(image)), Sift(2048).features(image)
    for a, b in ((ours, theirs), (theirs, ours)):
        distance, cosine = together(a, b)
        assert (distance < 0.5).mean() > 0.8
        assert np.median(distance) < 0.05
        assert np.nanmedian(cosine) > 0.99


def test_features_at_the_border_are_opencvs() -> None:
    """Beyond it in memory are other octaves, of which nothing may be seen."""
    image = rectangles(HEIGHT, WIDTH)
    ours, theirs = on_host(on_cpu().features(image)), Sift(2048).features(image)
    at_border = np.minimum(ours.keypoints, [WIDTH - 1, HEIGHT - 1] - ours.keypoints).min(axis=1) < 8
    assert at_border.sum() > 20
    distance, cosine = together(ours, theirs)
    assert (distance[at_border] < 0.5).mean() > 0.7
    assert np.nanmedian(cosine[at_border]) > 0.98


# The truth


@settings(deadline=None, max_examples=5)
@given(st.floats(-180, 180), st.floats(0.7, 1.4), st.floats(-5, 5), st.floats(-5, 5))
def test_matches_of_a_turned_scaled_and_moved_picture_are_where_they_belong(angle, scale, dx, dy) -> None:
    image = rectangles(HEIGHT, WIDTH)
    move = cv2.getRotationMatrix2D(((WIDTH - 1) / 2, (HEIGHT - 1) / 2), angle, scale)
    move[:, 2] += dx, dy
    moved = cv2.warpAffine(
        cv2.GaussianBlur(image, (0, 0), 0.8),
        move,
        (WIDTH, HEIGHT),
        flags=cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REFLECT,
    )

    def errors(sift: GpuSift | Sift, same_way_up: bool = False) -> np.ndarray:
        matches = sift.match(sift.features(image), sift.features(moved), same_way_up)
        return np.linalg.norm(matches.b - (matches.a @ move[:, :2].T + move[:, 2]), axis=1)

    ours, theirs = errors(on_cpu()), errors(Sift(2048))
    assert len(ours) > 0.9 * len(theirs) > 100
    assert (ours < 1.5).mean() > 0.9
    assert np.median(ours) < np.median(theirs) + 0.05
    for sift, found in ((on_cpu(), ours), (Sift(2048), theirs)):
        right = (errors(sift, same_way_up=True) < 1.5).sum() / (found < 1.5).sum()
        assert abs(angle) > 45 or right > 0.95
        assert abs(angle) < 75 or right < 0.05


@pytest.mark.parametrize("move", [(0.5, 0.0), (0.25, -0.75), (3.4, -2.3)])
def test_keypoints_move_by_fractions_of_a_pixel(move: tuple[float, float]) -> None:
    image = rectangles(HEIGHT, WIDTH)
    sift = on_cpu()
    matches = sift.match(sift.features(image), sift.features(shifted(image, *move)))
    error = matches.b - matches.a - move
    assert len(matches) > 300
    np.testing.assert_allclose(np.median(error, axis=0), 0, atol=0.06)
    assert np.median(np.abs(error)) < 0.06
    assert (np.abs(error).max(axis=1) < 0.5).mean() > 0.9


# On a GPU


def test_pictures_on_the_device_stay_there_until_the_matches() -> None:
    image = rectangles(HEIGHT, WIDTH)
    moved = shifted(image, 3.4, -2.3)
    reference = on_cpu()
    wanted = reference.match(reference.features(image), reference.features(moved))
    with simulated_gpu() as gpu:
        sift = GpuSift(2048, gpu.device)
        a = sift.features(image)
        on_device = torch.from_numpy(moved).to(gpu.device)
        gpu.reset()
        b = sift.features(on_device)
        assert (gpu.to_host, gpu.to_device, gpu.waits) == ([], [], ["nonzero"]), gpu.explain()
        assert len(gpu.operations) < 260, gpu.explain()
        for same_way_up in (True, False):
            gpu.reset()
            matches = sift.match(a, b, same_way_up)
            assert len(gpu.to_host) == len(gpu.waits) == 1, gpu.explain()
    np.testing.assert_array_equal(matches.a, wanted.a)
    np.testing.assert_array_equal(matches.b, wanted.b)
