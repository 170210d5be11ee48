"""Corners and their optical flow in torch, beside OpenCV's; what both must do is in test_track.py."""

from __future__ import annotations

import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from pictures import photo_of, smooth_noise
from stand_in.gpu import simulated_gpu

from gsfeatloc_ros.match.corners import MIN_CORNER_DISTANCE
from gsfeatloc_ros.match.track import (
    MAX_CORNERS,
    STRUCTURE_GAIN,
    STRUCTURE_MIN_CONTRAST,
    STRUCTURE_SIGMA,
    CornerTracker,
)
from gsfeatloc_ros.match.track_gpu import GpuCornerTracker

WIDTH, HEIGHT = 160, 120


def seen_through(image: np.ndarray, homography: np.ndarray) -> np.ndarray:
    size = image.shape[1::-1]
    return cv2.warpPerspective(image, homography, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def moved_by(homography: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    return cv2.perspectiveTransform(pixels[None].astype(np.float64), homography)[0]


def shift(dx: float, dy: float) -> np.ndarray:
    return np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1.0]])


def on_cpu(image: np.ndarray) -> GpuCornerTracker:
    return GpuCornerTracker(photo_of(image), "cpu")


@pytest.mark.parametrize("value", [0, 128, 255])
def test_blank_pictures_have_no_corners_and_no_matches(value: int) -> None:
    blank = np.full((HEIGHT, WIDTH, 3), value, np.uint8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tracker = on_cpu(blank)
        assert tracker.corners.shape == (0, 2)
        assert len(tracker.track(smooth_noise(0))) == 0
        assert len(on_cpu(smooth_noise(0)).track(blank)) == 0


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (9, 12), (16, 40), (31, 33)])
def test_small_pictures_do_no_harm(size: tuple[int, int]) -> None:
    image = smooth_noise(0)[: size[0], : size[1]]
    matches = on_cpu(image).track(image)
    np.testing.assert_allclose(matches.b, matches.a, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_corners_are_opencvs(seed: int) -> None:
    photo = photo_of(smooth_noise(seed, 300, 400))
    ours, theirs = GpuCornerTracker(photo, "cpu").corners, CornerTracker(photo).corners
    a, b = (set(map(tuple, corners)) for corners in (ours, theirs))
    assert len(theirs) > 300
    assert len(a & b) > 0.9 * len(a | b)
    # The strongest first.
    strongest = {tuple(corner) for corner in theirs[:25]}
    assert {tuple(corner) for corner in ours[:20]} <= strongest


def test_corners_keep_their_distance_also_in_noise_and_are_not_too_many() -> None:
    noise = np.random.default_rng(0).integers(256, size=(480, 640, 3), dtype=np.uint8)
    corners = on_cpu(noise).corners
    assert corners.dtype == np.float32
    assert len(corners) == MAX_CORNERS
    distances = np.linalg.norm(corners[:, None] - corners, axis=2) + 1e3 * np.eye(len(corners))
    assert distances.min() >= MIN_CORNER_DISTANCE


def test_corners_of_a_chessboard_which_are_all_equal_are_found_once() -> None:
    board = np.kron(np.indices((10, 14)).sum(axis=0) % 2, np.ones((14, 14)))[..., None] * np.full(3, 200.0)
    corners = on_cpu(board.astype(np.uint8)).corners
    assert len(corners) == 9 * 13
    # The fields meet half-way between the pixels 13 and 14, 27 and 28 and so on.
    np.testing.assert_array_less(5.0, np.abs((corners + 0.5) % 14 - 7))


def test_the_border_of_what_the_lens_saw_is_no_corner() -> None:
    photo = photo_of(smooth_noise(0))
    seen = np.zeros((HEIGHT, WIDTH), bool)
    seen[20:100, 30:130] = True
    photo = replace(photo, seen=seen, image=photo.image * seen[..., None].astype(np.uint8))
    corners = GpuCornerTracker(photo, "cpu").corners
    assert len(corners) > 20
    assert (corners >= [37, 27]).all()
    assert (corners <= [122, 92]).all()


def test_the_pyramid_is_of_local_structure_and_opencvs_halvings() -> None:
    photo = photo_of(smooth_noise(2, 151, 233))
    gray = photo.gray().astype(np.float32)
    centred = gray - cv2.GaussianBlur(gray, (0, 0), STRUCTURE_SIGMA)
    contrast = np.sqrt(cv2.GaussianBlur(centred**2, (0, 0), STRUCTURE_SIGMA))
    expected = np.clip(STRUCTURE_GAIN * centred / np.maximum(contrast, STRUCTURE_MIN_CONTRAST), -128, 128)
    for level in GpuCornerTracker(photo, "cpu")._pyramid:
        # Where brightness is half-way between two whole numbers OpenCV may take the other.
        np.testing.assert_allclose(level.structure[0, 0], expected, atol=5.0)
        assert np.abs(level.structure[0, 0].numpy() - expected).mean() < 0.02
        expected = cv2.pyrDown(expected)


@pytest.mark.parametrize("size", [0.5, 3.0])
@pytest.mark.parametrize("seed", range(4))
def test_flow_is_opencvs(seed: int, size: float) -> None:
    """A picture seen through a homography that moves its corners by `size` times some pixels."""
    rng = np.random.default_rng(seed)
    image = smooth_noise(seed)
    frame = np.array([[0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT]], np.float32)
    homography = cv2.getPerspectiveTransform(frame, frame + size * rng.normal(size=(4, 2)).astype(np.float32))
    other = seen_through(image, homography)
    tracker, opencv = on_cpu(image), CornerTracker(photo_of(image))
    ours, theirs = tracker.track(other), opencv.track(other)
    common = set(map(tuple, tracker.corners)) & set(map(tuple, opencv.corners))
    a, b = ({tuple(pixel): place for pixel, place in zip(m.a, m.b, strict=True)} for m in (ours, theirs))
    assert len(a.keys() & common) > len(b.keys() & common) - 0.05 * len(common)
    apart = [np.linalg.norm(a[corner] - b[corner]) for corner in a.keys() & b.keys()]
    assert len(apart) > 0.8 * len(opencv.corners)
    assert np.median(apart) < 0.03
    error, their_error = (np.median(np.linalg.norm(moved_by(homography, m.a) - m.b, axis=1)) for m in (ours, theirs))
    assert error < their_error + 0.01


def test_corners_that_leave_the_picture_are_not_found() -> None:
    image = smooth_noise(4)
    matches = on_cpu(image).track(seen_through(image, shift(-12.3, 0)))
    assert len(matches) > 50
    assert (matches.b >= 0).all()
    assert (matches.b <= [WIDTH - 1, HEIGHT - 1]).all()
    assert matches.a[:, 0].min() > 11
    assert np.mean(np.linalg.norm(matches.b - matches.a - [-12.3, 0], axis=1) < 0.3) > 0.9


def test_on_a_gpu_all_stays_there_but_what_is_found() -> None:
    image, other = smooth_noise(0), seen_through(smooth_noise(0), shift(2.5, -1.5))
    expected = on_cpu(image).track(other)
    with simulated_gpu() as gpu:
        render = torch.from_numpy(other).to(gpu.device)
        gpu.reset()
        tracker = GpuCornerTracker(photo_of(image), gpu.device)
        assert len(gpu.to_host) == 1, gpu.explain()
        gpu.reset()
        matches = tracker.track(render)
        assert len(gpu.waits) == len(gpu.to_host) == 1, gpu.explain()
        assert not gpu.to_device, gpu.explain()
        assert len(gpu.operations) < 700, gpu.explain()
        np.testing.assert_allclose(matches.a, expected.a)
        np.testing.assert_allclose(matches.b, expected.b, atol=1e-4)
        np.testing.assert_array_equal(matches.scores, 1.0)
        # A picture of the host's is as good.
        np.testing.assert_array_equal(tracker.track(other).b, matches.b)
