"""Decode sensor_msgs/CompressedImage: what its format declares, and what its bytes are.

The format is that of compressed_image_transport, "rgb8; jpeg compressed bgr8": the encoding of the raw image, what it
is compressed to, and the encoding in which that was done. Others write "jpeg" or "png" alone. Which of the two it is,
the bytes tell.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from gsfeatloc_ros.common.jpeg_png import Picture, decode, read_header
from gsfeatloc_ros.ros_io.message_types import CompressedImage
from gsfeatloc_ros.ros_io.raw_image import ENCODINGS

# Encodings whose samples are no colours, unless they were converted before they were compressed.
_PATTERNS = ("bayer", "yuv", "uyvy", "yuyv", "nv")
_VIDEO = ("264", "265", "hevc", "av1", "vp8", "vp9", "mpeg", "theora", "ffmpeg", "video")
# OpenCV's names, of which some are no pictures: depth, offsets, labels.
_OPENCV_ENCODING = re.compile(r"\d+[USF]C\d*")


class PictureError(ValueError):
    """The picture of an image message cannot be used, or is of another size than its camera's."""


class _Format(NamedTuple):
    """What a format declares: the encoding of the raw image, and that in which it was compressed; empty for nothing."""

    encoding: str
    compressed: str


def encoding_of(message: CompressedImage) -> str:
    """Return the encoding of the raw image, where that is declared, or else the whole format."""
    return _parse(message.format).encoding or message.format


def open_compressed_image(message: CompressedImage) -> Picture:
    """Return what there is to decode, and of which size it is, without decoding it.

    Raises:
        PictureError: no JPEG or PNG, a damaged one, or one that takes more than any camera's: a few bytes can hold
            gigabytes; or what is declared to be a depth image, or the raw pattern of a Bayer filter.
    """
    named = f"image of format {message.format!r}"
    encoding, compressed = _parse(message.format)
    if "compressedDepth" in message.format or encoding.startswith("32FC"):
        raise PictureError(f"{named} is a depth image: take the topic of the pictures")
    if _OPENCV_ENCODING.fullmatch(encoding) and encoding not in ENCODINGS:
        raise PictureError(f"{named} is no picture: take the topic of the pictures")
    if encoding.startswith(_PATTERNS) and not compressed:
        raise PictureError(f"{named} has no colours yet: take the topic of the colour images")
    try:
        return read_header(bytes(message.data))
    except ValueError as error:
        is_video = "video" in str(error) or any(name in message.format.lower() for name in _VIDEO)
        advice = ": let image_transport's republish decode the video, to raw or compressed" if is_video else ""
        raise PictureError(f"{named}, {len(message.data)} bytes, {error}{advice}") from error


def decode_compressed_image(message: CompressedImage, picture: Picture) -> np.ndarray:
    """Return the pixels (H, W, 3) RGB of a message's picture, uint8 or uint16; an alpha channel is dropped.

    Raises:
        PictureError: it is damaged.
    """
    try:
        rgb = decode(picture)
    except ValueError as error:
        raise PictureError(f"image of format {message.format!r}, {len(message.data)} bytes, {error}") from error
    # Who compresses RGB as if it were OpenCV's BGR says so.
    swapped = _parse(message.format).compressed.startswith("rgb")
    return np.ascontiguousarray(rgb[:, :, ::-1]) if swapped else rgb


def _parse(declared: str) -> _Format:
    """Take a format apart; one of a single word declares nothing."""
    encoding, separator, rest = declared.partition(";")
    return _Format(encoding.strip() if separator else "", rest.partition("compressed")[2].strip())
