"""Decode sensor_msgs/Image, in every encoding that is of a picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gsfeatloc_ros.ros_io.message_types import Image

# Pixels. No camera is larger; a message that says so is corrupt.
MAX_SIDE = 16384
# What sensors have, in bits; images of 16 bits a sample hold the lower ones unscaled.
SAMPLE_BITS = (8, 10, 12, 14, 16)


@dataclass(frozen=True)
class _Encoding:
    """How the pixels of an image encoding lie in memory.

    Attributes:
        channels: samples per pixel as stored (YUV 4:2:2 stores two), in a row.
        bits: 8 or 16 bits per sample.
        conversion: cv2.cvtColor code that makes it RGB; None where it is RGB.
        multiple: width and height must be multiples of these.
        smallest: least width and height that can be converted.
        planes: rows of data for two rows of pixels; more than two where the chroma lies below the brightness.
    """

    channels: int
    bits: int
    conversion: int | None
    multiple: tuple[int, int] = (1, 1)
    smallest: tuple[int, int] = (1, 1)
    planes: int = 2


def _bayer(bits: int, conversion: int) -> _Encoding:
    # Bilinear interpolation in OpenCV leaves images of less than 3x3 pixels black.
    return _Encoding(1, bits, conversion, smallest=(3, 3))


def _yuv422(conversion: int) -> _Encoding:
    return _Encoding(2, 8, conversion, multiple=(2, 1), smallest=(2, 1))


def _semiplanar(conversion: int, planes: int) -> _Encoding:
    return _Encoding(1, 8, conversion, multiple=(2, 2), smallest=(2, 2), planes=planes)


# The names of sensor_msgs/image_encodings.hpp that are of pictures, and nv12 of Isaac ROS; those like 8UC3 are in
# OpenCV's order. Of OpenCV's own names for Bayer patterns only the four-letter ones mean the same as in ROS.
ENCODINGS = {
    "rgb8": _Encoding(3, 8, None),
    "bgr8": _Encoding(3, 8, cv2.COLOR_BGR2RGB),
    "rgba8": _Encoding(4, 8, cv2.COLOR_RGBA2RGB),
    "bgra8": _Encoding(4, 8, cv2.COLOR_BGRA2RGB),
    "rgb16": _Encoding(3, 16, None),
    "bgr16": _Encoding(3, 16, cv2.COLOR_BGR2RGB),
    "rgba16": _Encoding(4, 16, cv2.COLOR_RGBA2RGB),
    "bgra16": _Encoding(4, 16, cv2.COLOR_BGRA2RGB),
    "8UC1": _Encoding(1, 8, cv2.COLOR_GRAY2RGB),
    "8UC3": _Encoding(3, 8, cv2.COLOR_BGR2RGB),
    "8UC4": _Encoding(4, 8, cv2.COLOR_BGRA2RGB),
    "16UC1": _Encoding(1, 16, cv2.COLOR_GRAY2RGB),
    "16UC3": _Encoding(3, 16, cv2.COLOR_BGR2RGB),
    "16UC4": _Encoding(4, 16, cv2.COLOR_BGRA2RGB),
    "mono8": _Encoding(1, 8, cv2.COLOR_GRAY2RGB),
    "mono16": _Encoding(1, 16, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": _bayer(8, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": _bayer(8, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": _bayer(8, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": _bayer(8, cv2.COLOR_BayerGRBG2RGB),
    "bayer_rggb16": _bayer(16, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr16": _bayer(16, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg16": _bayer(16, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg16": _bayer(16, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": _yuv422(cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": _yuv422(cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": _yuv422(cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": _yuv422(cv2.COLOR_YUV2RGB_YUY2),
    "nv12": _semiplanar(cv2.COLOR_YUV2RGB_NV12, planes=3),
    "nv21": _semiplanar(cv2.COLOR_YUV2RGB_NV21, planes=3),
    "nv24": _semiplanar(cv2.COLOR_YUV2RGB_NV12, planes=6),
}


def validate_image(message: Image) -> None:
    """Check that an image can be decoded, without touching the pixels.

    Raises:
        ValueError: unknown encoding, a size that no camera has, or data and step that do not hold the pixels.
    """
    encoding = ENCODINGS.get(message.encoding)
    if message.encoding == "32FC1":
        raise ValueError("image encoding '32FC1' is that of depth images: take the topic of the pictures")
    if encoding is None:
        raise ValueError(f"image encoding {message.encoding!r} is not supported: publish one of {', '.join(ENCODINGS)}")
    width, height = message.width, message.height
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise ValueError(f"image size {width}x{height} must be 1 to {MAX_SIDE} pixels a side: check the camera driver")
    if width < encoding.smallest[0] or height < encoding.smallest[1]:
        raise ValueError(f"image size {width}x{height} is too small for {message.encoding}")
    if width % encoding.multiple[0] or height % encoding.multiple[1]:
        raise ValueError(
            f"image size {width}x{height} must be a multiple of {encoding.multiple[0]}x{encoding.multiple[1]} "
            f"for {message.encoding}: check the camera driver"
        )
    row_bytes = width * encoding.channels * encoding.bits // 8
    if message.step < row_bytes:
        raise ValueError(
            f"image step {message.step} is less than the {row_bytes} bytes of a row of {width} {message.encoding} "
            "pixels: check the camera driver"
        )
    needed = message.step * height * encoding.planes // 2
    if len(message.data) < needed:
        raise ValueError(
            f"image data has {len(message.data)} bytes but step {message.step} x height {height} needs "
            f"{needed}{'' if encoding.planes == 2 else ' with the chroma'}: the image was cut short, check the camera "
            "driver"
        )


def decode_image(message: Image, bits: int = 16) -> np.ndarray:
    """Return the pixels (H, W, 3) uint8 RGB of an image of any of the ENCODINGS; an alpha channel is dropped.

    Args:
        message: the image.
        bits: of the samples of 16-bit images that are used: the largest number of so many bits becomes 255.

    Raises:
        ValueError: see validate_image.
    """
    pixels = _samples(message)
    encoding = ENCODINGS[message.encoding]
    if message.encoding == "nv24":
        # A chroma of each pixel, in rows of twice the width: OpenCV takes one of four (NV12).
        brightness, chroma = np.split(pixels, [message.height])
        chroma = chroma.reshape(message.height, message.width, 2)[::2, ::2]
        pixels = np.vstack([brightness, chroma.reshape(-1, message.width)])
    if encoding.bits == 16:
        pixels = in_8_bits(pixels, bits)
    if encoding.channels > 1:
        pixels = pixels.reshape(message.height, message.width, encoding.channels)
    return pixels if encoding.conversion is None else cv2.cvtColor(pixels, encoding.conversion)


def largest_sample(message: Image) -> int:
    """Return the largest value in an image; raise ValueError as validate_image does."""
    return int(_samples(message).max())


def needed_bits(largest: int) -> int:
    """Return how many bits samples up to the largest need, one of SAMPLE_BITS."""
    return next(bits for bits in SAMPLE_BITS if largest < 2**bits)


def in_8_bits(samples: np.ndarray, bits: int) -> np.ndarray:
    """Return samples uint16 as uint8: the largest number of so many bits becomes 255."""
    return cv2.convertScaleAbs(samples, alpha=255.0 / (2**bits - 1))


def _samples(message: Image) -> np.ndarray:
    """Return the samples (rows, samples a row), uint8 or uint16; raise ValueError as validate_image does."""
    validate_image(message)
    encoding = ENCODINGS[message.encoding]
    height = message.height * encoding.planes // 2
    rows = np.frombuffer(message.data, np.uint8, count=message.step * height)
    rows = rows.reshape(height, message.step)[:, : message.width * encoding.channels * encoding.bits // 8]
    samples: np.ndarray = np.ascontiguousarray(rows)
    if encoding.bits == 16:
        samples = samples.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
    return samples
