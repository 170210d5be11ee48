"""JPEG and PNG files that no camera writes."""

from __future__ import annotations

import struct
import zlib


def png_chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, pixels: bytes) -> bytes:
    """A grey PNG that says that it is so large."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", pixels) + png_chunk(b"IEND", b"")


def jpeg_with_hidden_size(jpeg: bytes, width: int, height: int, side: int) -> bytes:
    """A baseline JPEG of `side` x `side`, with a frame of `width` x `height` in bytes that libjpeg skips."""
    start = jpeg.index(b"\xff\xc0")
    frame = jpeg[start : start + 19]
    skipped = b"\0" + frame[1:5] + struct.pack(">HH", height, width) + frame[9:]
    return jpeg[:start] + skipped + frame[:5] + struct.pack(">HH", side, side) + jpeg[start + 9 :]
