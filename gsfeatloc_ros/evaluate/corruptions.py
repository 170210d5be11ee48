"""Corruptions of photos that are of the scene: bad light, bad optics, things in the way, a wrong calibration."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera

Corruption: TypeAlias = Callable[[np.ndarray, Camera, np.random.Generator], tuple[np.ndarray, Camera]]
"""Makes of a photo (H, W, 3) uint8 RGB and its camera the photo and the camera that the localizer is given."""

# Lengths are in pixels of a photo so wide.
_REFERENCE_WIDTH = 640
_DEFOCUS_SIGMA = 2.5
_NOISE_SIGMA = 25.0  # levels of 255
_NOISE_SEED = 0  # of all photos
_BLOB_SHARE = 0.3  # of the photo at least
_BLOB_AXES = (0.05, 0.15)  # half axes, of the photo's width
_WHITE_BALANCE = (1.3, 1.0, 0.7)  # gains of red, green and blue


def corrupt(name: str, image: np.ndarray, camera: Camera, seed: tuple[int, ...]) -> tuple[np.ndarray, Camera]:
    """Do one of CORRUPTIONS to a photo (H, W, 3) uint8 RGB: the same for the same name and seed."""
    return CORRUPTIONS[name](image, camera, np.random.default_rng([*seed, zlib.crc32(name.encode())]))


def _of_image(change: Callable[[np.ndarray], np.ndarray]) -> Corruption:
    """Make the corruption that changes the photo alone, and nothing by chance."""
    return lambda image, camera, rng: (change(image), camera)


def _pixels(length: float, image: np.ndarray) -> float:
    return length * image.shape[1] / _REFERENCE_WIDTH


def _expose(gain: float, gamma: float) -> Corruption:
    """Multiply the light and change its curve."""
    levels = np.clip(gain * (np.arange(256) / 255.0) ** gamma, 0, 1)
    return _of_image(lambda image: cv2.LUT(image, np.rint(255 * levels).astype(np.uint8)))


def _shade(image: np.ndarray) -> np.ndarray:
    ramp = np.linspace(0.2, 1.3, image.shape[1])[None, :, None]
    return np.clip(image * ramp, 0, 255).astype(np.uint8)


def _add_noise(image: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(_NOISE_SEED).normal(0.0, _NOISE_SIGMA, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def _make_grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)


def _tint(image: np.ndarray) -> np.ndarray:
    return np.clip(image * np.array(_WHITE_BALANCE), 0, 255).astype(np.uint8)


def _compress(quality: int) -> Corruption:
    """Store as a JPEG of a quality in percent; the file has the colours in OpenCV's order."""

    def compress(image: np.ndarray) -> np.ndarray:
        _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR))

    return _of_image(compress)


def _defocus(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), _pixels(_DEFOCUS_SIGMA, image))


def _move(length: float) -> Corruption:
    """Blur along the rows, as a camera that pans does."""
    return _of_image(lambda image: cv2.blur(image, (max(1, round(_pixels(length, image))), 1)))


def _roll(skew: float) -> Corruption:
    """Shear the rows, as the rolling shutter of a camera that pans does: so many pixels between the first and last."""

    def roll(image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        y, x = np.mgrid[:height, :width].astype(np.float32)
        shift = _pixels(skew, image) * (y / height - 0.5)
        return cv2.remap(image, (x + shift).astype(np.float32), y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    return _of_image(roll)


def _cover(share: float) -> Corruption:
    """Put another part of the photo, upside down, over a share of it in the middle."""

    def cover(image: np.ndarray) -> np.ndarray:
        height, width = (round(share**0.5 * side) for side in image.shape[:2])
        top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
        covered = image.copy()
        covered[top : top + height, left : left + width] = image[:height, :width][::-1, ::-1]
        return covered

    return _of_image(cover)


def _cover_left(share: float) -> Corruption:
    """Put the right part of the photo, upside down, over the left."""

    def cover(image: np.ndarray) -> np.ndarray:
        width = int(share * image.shape[1])
        covered = image.copy()
        covered[:, :width] = image[:, -width:][::-1, ::-1]
        return covered

    return _of_image(cover)


def _fill_right_half(level: int) -> Corruption:
    def fill(image: np.ndarray) -> np.ndarray:
        filled = image.copy()
        filled[:, image.shape[1] // 2 :] = level
        return filled

    return _of_image(fill)


def _cover_with_blobs(image: np.ndarray, camera: Camera, rng: np.random.Generator) -> tuple[np.ndarray, Camera]:
    """Put ellipses of the photo turned by 180 degrees over it, until they cover enough."""
    height, width = image.shape[:2]
    blobs = np.zeros((height, width), np.uint8)
    while blobs.mean() < _BLOB_SHARE:
        centre = int(rng.uniform(0, width)), int(rng.uniform(0, height))
        axes = int(rng.uniform(*_BLOB_AXES) * width), int(rng.uniform(*_BLOB_AXES) * width)
        cv2.ellipse(blobs, centre, axes, rng.uniform(0, 180), 0, 360, 1, -1)
    return np.where(blobs[..., None] > 0, image[::-1, ::-1], image), camera


def _miscalibrate_focal(percent: float) -> Corruption:
    """Claim a focal length that is off; the photo stays as it is."""

    def miscalibrate(image: np.ndarray, camera: Camera, rng: np.random.Generator) -> tuple[np.ndarray, Camera]:
        return image, camera.zoomed(percent / 100)

    return miscalibrate


def _miscalibrate_k1(k1: float) -> Corruption:
    """Claim a first radial coefficient that is off."""

    def miscalibrate(image: np.ndarray, camera: Camera, rng: np.random.Generator) -> tuple[np.ndarray, Camera]:
        if not camera.distorted:
            camera = replace(camera.pinhole(), distortion=np.zeros(5))
        distortion = camera.distortion.copy() if len(camera.distortion) else np.zeros(4)
        distortion[0] += k1
        return image, replace(camera, distortion=distortion)

    return miscalibrate


def _shrink(width: int) -> Corruption:
    """Resize to at most a width in pixels."""
    return lambda image, camera, rng: camera.limit(image, width)


def _crop(across: float, down: float) -> Corruption:
    """Cut out a part, of these shares of the width and the height, anywhere."""

    def crop(image: np.ndarray, camera: Camera, rng: np.random.Generator) -> tuple[np.ndarray, Camera]:
        width, height = int(across * camera.width), int(down * camera.height)
        left, top = (int(rng.integers(0, room + 1)) for room in (camera.width - width, camera.height - height))
        K = camera.K.copy()
        K[:2, 2] -= left, top
        cropped = np.ascontiguousarray(image[top : top + height, left : left + width])
        return cropped, replace(camera, width=width, height=height, K=K)

    return crop


OCCLUSIONS: dict[str, Corruption] = {
    "cover-20": _cover(0.2),
    "cover-40": _cover(0.4),
    "cover-60": _cover(0.6),
    "left-40": _cover_left(0.4),
    "half-black": _fill_right_half(0),
    "half-white": _fill_right_half(255),
    "blobs": _cover_with_blobs,
}
MISCALIBRATIONS: dict[str, Corruption] = {
    **{f"focal{percent:+d}": _miscalibrate_focal(percent) for percent in (-10, -5, -3, -2, -1, 1, 2, 3, 5, 10)},
    "k1-0.05": _miscalibrate_k1(-0.05),
}
CORRUPTIONS: dict[str, Corruption] = {
    "dark": _expose(0.3, 1.5),
    "bright": _expose(1.4, 0.6),
    "gamma": _expose(1.0, 2.2),
    "shade": _of_image(_shade),
    "white-balance": _of_image(_tint),
    "grey": _of_image(_make_grey),
    "noise": _of_image(_add_noise),
    "jpeg-10": _compress(10),
    "defocus": _of_image(_defocus),
    "motion": _move(15),
    "motion-25": _move(25),
    "rolling-4": _roll(4),
    "rolling-8": _roll(8),
    **OCCLUSIONS,
    "small-320": _shrink(320),
    "small-160": _shrink(160),
    "small-80": _shrink(80),
    "crop": _crop(0.5, 0.5),
    "portrait": _crop(0.45, 1.0),
    **MISCALIBRATIONS,
}
"""By name. Those of OCCLUSIONS hide parts of the scene, those of MISCALIBRATIONS leave the photo as it is."""
