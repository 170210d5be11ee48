"""JPEG and PNG pictures of unknown origin, read so strictly that they cost no more than their size says.

Decoders forgive much. libjpeg skips bytes in which another size may stand, and draws each of a million scans; libpng
inflates comments of gigabytes. Here a JPEG must be one segment after another, and of a PNG the decoder is given no more
than what makes its pixels: what is found here is what it finds.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

# Pixels. As many no robot's camera has; as RGB they take 150 MB, of 16 bits 300 MB.
MAX_PIXELS = 50_000_000
# Those of cameras and phones have about 20, with EXIF, a thumbnail and a colour profile.
_MAX_JPEG_SEGMENTS = 200
# The usual progressive JPEG has 10, a thumbnail in it one or 10 more. Each takes as long as the whole picture.
_MAX_JPEG_SCANS = 64
_JPEG_START, _JPEG_SCAN = b"\xff\xd8", 0xDA
# Baseline, extended and progressive, with Huffman or arithmetic coding (ITU-T T.81, table B.1).
_JPEG_FRAMES = (0xC0, 0xC1, 0xC2, 0xC9, 0xCA)
# Tables, restart interval, applications' data, comment.
_JPEG_OTHERS = (0xC4, 0xCC, 0xDB, 0xDD, *range(0xE0, 0xF0), 0xFE)
_PNG_START = b"\x89PNG\r\n\x1a\n"
# Red, green, blue and alpha of 16 bits; palette, frames of chunks and of what does not compress.
_MAX_PNG_PIXEL_BYTES, _MAX_PNG_OVERHEAD = 9, 65536
# What makes the pixels, and tells how they are turned.
_PNG_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"eXIf", b"IDAT", b"IEND")
# Of OpenCV: turned as EXIF says, and not.
_COLOURS = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
_AS_STORED = _COLOURS | cv2.IMREAD_IGNORE_ORIENTATION
# What else images are sent as, by place and bytes.
_OTHER_KINDS = (
    (8, b"WEBP", "WebP"),
    (0, b"\0\0\0\1", "video (H.264, H.265)"),
    (0, b"\0\0\1", "video (H.264, H.265, MPEG)"),
    (0, b"OggS", "video (Theora)"),
    (0, b"\x1aE\xdf\xa3", "video (Matroska, WebM)"),
    (4, b"ftypavif", "AVIF"),
    (4, b"ftypheic", "HEIC"),
    (4, b"ftyp", "video (MP4)"),
    (0, b"II*\0", "TIFF"),
    (0, b"MM\0*", "TIFF"),
    (0, b"\0\0\0\x0cjP", "JPEG 2000"),
    (0, b"\xff\x4f\xff\x51", "JPEG 2000"),
    (0, b"\0\0\0\x0cJXL", "JPEG XL"),
    (0, b"\xff\x0a", "JPEG XL"),
    (0, b"\x28\xb5\x2f\xfd", "packed by Zstandard"),
    (0, b"\x1f\x8b", "packed by gzip"),
    (0, b"GIF8", "GIF"),
    (0, b"BM", "BMP"),
    (0, b"qoif", "QOI"),
    # Behind the parameters of compressed_depth_image_transport.
    (12, _PNG_START, "a depth image (compressedDepth)"),
)


class Picture(NamedTuple):
    """A picture that is not decoded yet.

    Attributes:
        width, height: in pixels.
        data: that the decoder is to see.
        bits: of a sample when it is decoded, 8 or 16.
    """

    width: int
    height: int
    data: bytes
    bits: int = 8


def read_header(data: bytes) -> Picture:
    """Return what there is to decode of a JPEG or PNG, and of which size it is.

    Raises:
        ValueError: it is neither, damaged, or takes more than any camera's picture.
    """
    if data.startswith(_JPEG_START):
        picture = _read_jpeg(data)
    elif data.startswith(_PNG_START):
        picture = _read_png(data)
    else:
        kind = next((kind for place, start, kind in _OTHER_KINDS if data[place:].startswith(start)), "")
        raise ValueError(f"is {kind}, no JPEG or PNG" if kind else "is no JPEG or PNG")
    width, height = picture.width, picture.height
    if width * height == 0:
        raise ValueError("has no pixels")
    if width * height > MAX_PIXELS:
        raise ValueError(f"is of size {width}x{height}, more than {MAX_PIXELS // 10**6} megapixels")
    return picture


def decode(picture: Picture) -> np.ndarray:
    """Return the pixels (H, W, 3) RGB, uint8 or uint16; alpha is dropped, an orientation that EXIF tells ignored.

    Raises:
        ValueError: the picture is damaged.
    """
    return cv2.cvtColor(_decode(picture, _AS_STORED), cv2.COLOR_BGR2RGB)


def decode_with_alpha(picture: Picture) -> np.ndarray:
    """As `decode`, but with the alpha channel (H, W, 4) of a picture that has one."""
    pixels = _decode(picture, cv2.IMREAD_UNCHANGED)
    if pixels.ndim == 2:
        return cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB)
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB)


def decode_upright(picture: Picture) -> np.ndarray:
    """As `decode`, turned as EXIF says."""
    return cv2.cvtColor(_decode(picture, _COLOURS), cv2.COLOR_BGR2RGB)


def _decode(picture: Picture, flags: int) -> np.ndarray:
    """Return what OpenCV makes of a picture."""
    try:
        pixels = cv2.imdecode(np.frombuffer(picture.data, np.uint8), flags)
    except cv2.error as error:
        raise ValueError(f"cannot be decoded: {error.err}") from error
    sizes = [(picture.height, picture.width)]
    if flags == _COLOURS:
        sizes.append((picture.width, picture.height))
    if pixels is None or pixels.shape[:2] not in sizes or 8 * pixels.itemsize != picture.bits:
        raise ValueError("is damaged")
    return pixels


def _read_jpeg(data: bytes) -> Picture:
    """Read the segments up to the first scan."""
    scans = data.count(bytes([0xFF, _JPEG_SCAN]))
    if scans > _MAX_JPEG_SCANS:
        raise ValueError(f"is a JPEG of {scans} scans, at most {_MAX_JPEG_SCANS} are decoded")
    size = None
    for marker, segment in itertools.islice(_jpeg_segments(data), _MAX_JPEG_SEGMENTS):
        if marker == _JPEG_SCAN and size is not None:
            return Picture(*size, data)
        if marker in _JPEG_FRAMES and size is None and len(segment) >= 5:
            if segment[0] != 8:
                raise ValueError(f"is a JPEG of {segment[0]} bits, those of 8 are decoded")
            size = int.from_bytes(segment[3:5], "big"), int.from_bytes(segment[1:3], "big")
        elif marker not in _JPEG_OTHERS:
            raise ValueError(f"is a damaged JPEG, or of a kind that is not decoded (marker {marker:02X})")
    raise ValueError("is a damaged JPEG")


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield marker and content of each segment after the start, as long as one directly follows the other."""
    place = len(_JPEG_START)
    while place + 4 <= len(data) and data[place] == 0xFF:
        if data[place + 1] == 0xFF:  # any number of these may come before a marker
            place += 1
            continue
        end = place + 2 + int.from_bytes(data[place + 2 : place + 4], "big")
        if not place + 4 <= end <= len(data):
            return
        yield data[place + 1], data[place + 4 : end]
        place = end


def _read_png(data: bytes) -> Picture:
    """Keep the chunks that make and turn the pixels, of which the first tells the size: no comments, no animations."""
    if data[8:16] != b"\0\0\0\rIHDR":
        raise ValueError("is a damaged PNG")
    kept, place = [_PNG_START], len(_PNG_START)
    while place < len(data):
        end = place + 12 + int.from_bytes(data[place : place + 4], "big")
        # The decoder takes memory for as many bytes as a chunk claims to have.
        if end > len(data):
            raise ValueError("is a damaged PNG: it is cut short")
        kind = data[place + 4 : place + 8]
        if kind in _PNG_CHUNKS:
            kept.append(data[place:end])
        place = end
    width, height, depth = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"), data[24:25]
    picture = Picture(width, height, b"".join(kept), bits=16 if depth == b"\x10" else 8)
    # What does not compress stays as large as it is; of more all is unpacked in vain, a thousand times as much.
    if len(picture.data) > _MAX_PNG_OVERHEAD + _MAX_PNG_PIXEL_BYTES * picture.width * picture.height:
        raise ValueError(f"is a PNG of {picture.width}x{picture.height} pixels that holds more than these")
    return picture
