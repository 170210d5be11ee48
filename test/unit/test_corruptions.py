"""Corruptions: what is done to photos and cameras."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import cv2
import numpy as np
import pytest

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.evaluate.corruptions import CORRUPTIONS, MISCALIBRATIONS, OCCLUSIONS, corrupt

SEED = (0, 3)
CAMERA = Camera(320, 240, np.array([[300.0, 0, 159.5], [0, 310.0, 119.5], [0, 0, 1]]))
SIZES = {
    "small-320": (320, 240),
    "small-160": (160, 120),
    "small-80": (80, 60),
    "crop": (160, 120),
    "portrait": (144, 240),
}
# SHA-256, cut, of what each made of the photo below when they came to be: figures measured with them stay comparable.
FIRST = {
    "dark": "448ac729b9226285",
    "bright": "798a798c0a2947cd",
    "shade": "5514d1d9b9e0aea3",
    "noise": "cbc0e590826b1698",
    "defocus": "a26cbefbe0c07c5d",
    "motion": "2045eec4c28100c4",
    "cover-20": "47921855b8c7d04d",
    "cover-40": "f4d607925db44b23",
    "cover-60": "db4a27ba8933b4c4",
}


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    """A photo of blurred noise with colours."""
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    image = cv2.blur(noise, (5, 5)).astype(np.int32) * 3 - 256
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_corruptions_give_a_photo_of_their_camera_and_the_same_again(name, image):
    kept = image.copy()
    corrupted, camera = corrupt(name, image, CAMERA, SEED)
    np.testing.assert_array_equal(image, kept)
    assert corrupted.shape == (camera.height, camera.width, 3)
    assert corrupted.dtype == np.uint8
    again, camera_again = corrupt(name, image, CAMERA, SEED)
    np.testing.assert_array_equal(again, corrupted)
    np.testing.assert_array_equal(camera_again.K, camera.K)
    if name in MISCALIBRATIONS:
        np.testing.assert_array_equal(corrupted, image)
    elif name not in SIZES:
        assert camera is CAMERA
        assert (corrupted != image).any(axis=2).mean() > (0.15 if name in OCCLUSIONS else 0.5)


@pytest.mark.parametrize("name", FIRST)
def test_corruptions_are_what_they_were(name, image):
    corrupted, _ = corrupt(name, image, CAMERA, SEED)
    assert hashlib.sha256(corrupted.tobytes()).hexdigest()[:16] == FIRST[name]


@pytest.mark.parametrize(
    ("name", "share"),
    [
        ("cover-20", 0.2),
        ("cover-40", 0.4),
        ("cover-60", 0.6),
        ("left-40", 0.4),
        ("half-black", 0.5),
        ("half-white", 0.5),
    ],
)
def test_occlusions_cover_what_they_say(name, share, image):
    corrupted, _ = corrupt(name, image, CAMERA, SEED)
    assert (corrupted != image).any(axis=2).mean() == pytest.approx(share, abs=0.02)


def test_blobs_are_others_in_each_photo_and_run(image):
    blobs = [corrupt("blobs", image, CAMERA, seed)[0] for seed in ((0, 3), (0, 4), (1, 3))]
    for corrupted in blobs:
        assert 0.28 < (corrupted != image).any(axis=2).mean() < 0.45
    assert (blobs[0] != blobs[1]).any()
    assert (blobs[0] != blobs[2]).any()


def test_halves_are_black_or_white(image):
    for name, level in (("half-black", 0), ("half-white", 255)):
        corrupted, _ = corrupt(name, image, CAMERA, SEED)
        assert (corrupted[:, 160:] == level).all()
        np.testing.assert_array_equal(corrupted[:, :160], image[:, :160])


@pytest.mark.parametrize(("name", "skew"), [("rolling-4", 2), ("rolling-8", 4)])
def test_a_rolling_shutter_shears_rows_in_pixels_of_a_photo_640_wide(name, skew, image):
    corrupted, _ = corrupt(name, image, CAMERA, SEED)
    np.testing.assert_array_equal(corrupted[120], image[120])
    # The first row is taken from half the skew to the left.
    half = skew // 2
    np.testing.assert_array_equal(corrupted[0, half:], image[0, :-half])


def test_colours_go(image):
    grey, _ = corrupt("grey", image, CAMERA, SEED)
    assert (grey.max(axis=2) == grey.min(axis=2)).all()
    tinted, _ = corrupt("white-balance", image, CAMERA, SEED)
    np.testing.assert_array_equal(tinted[..., 1], image[..., 1])
    assert tinted[..., 0].mean() > image[..., 0].mean()
    assert tinted[..., 2].mean() < image[..., 2].mean()


@pytest.mark.parametrize("percent", [-10, -5, -3, -2, -1, 1, 2, 3, 5, 10])
def test_a_wrong_focal_length_is_claimed(percent, image):
    _, camera = corrupt(f"focal{percent:+d}", image, CAMERA, SEED)
    factor = 1 + percent / 100
    np.testing.assert_allclose(camera.K, CAMERA.K * [[factor, 1, 1], [1, factor, 1], [1, 1, 1]])


@pytest.mark.parametrize(
    ("distortion", "model", "k1"),
    [([], "plumb_bob", 0.0), ([0.1, 0, 0, 0], "plumb_bob", 0.1), ([], "equidistant", 0.0)],
)
def test_a_wrong_k1_is_claimed(distortion, model, k1, image):
    known = replace(CAMERA, distortion=np.array(distortion), model=model)
    _, camera = corrupt("k1-0.05", image, known, SEED)
    assert camera.model == model
    assert camera.distortion[0] == pytest.approx(k1 - 0.05)
    assert not camera.distortion[1:].any()


@pytest.mark.parametrize("name", SIZES)
def test_small_and_cut_photos_show_the_same_world(name, image):
    """A gradient says where each pixel came from: its ray must be that of the camera."""
    columns, rows = np.meshgrid(np.arange(320), np.arange(240))
    gradient = np.dstack([columns * 255 / 319, rows * 255 / 239, np.zeros_like(rows)]).astype(np.uint8)
    corrupted, camera = corrupt(name, gradient, CAMERA, SEED)
    pixel = np.array([[camera.width // 2, camera.height // 2]])
    seen = CAMERA.project(camera.rays(pixel))[0]
    red, green, _ = corrupted[pixel[0, 1], pixel[0, 0]].astype(float)
    np.testing.assert_allclose([red * 319 / 255, green * 239 / 255], seen, atol=2.5)
    assert (camera.width, camera.height) == SIZES[name]


def test_a_photo_is_not_enlarged(image):
    small, camera = corrupt("small-160", image[:120, :160], CAMERA.scaled(160, 120), SEED)
    assert small.shape == (120, 160, 3)
    larger, camera = corrupt("small-320", small, camera, SEED)
    assert larger.shape == (120, 160, 3)
    assert camera.width == 160
