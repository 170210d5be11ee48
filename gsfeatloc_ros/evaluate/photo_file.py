"""Photos of data sets, files of unknown origin: their size is known before memory is taken for it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from gsfeatloc_ros.common.jpeg_png import Picture, decode_upright, decode_with_alpha, read_header
from gsfeatloc_ros.common.safe_files import read_regular

# The largest photo that is decoded, of 16 bits with alpha that do not compress.
_MAX_BYTES = 500_000_000


def photo_size(path: Path) -> tuple[int, int]:
    """Return width and height of a photo as it is stored.

    Raises:
        ValueError: the file is missing, cannot be read, or is no JPEG or PNG that is decoded.
    """
    picture = _open(path)
    return picture.width, picture.height


def read_photo(path: Path, upright: bool = False) -> np.ndarray:
    """Read a photo as RGB or, where it has an alpha channel, RGBA: (H, W, 3 or 4) uint8; a grey one has three equal.

    Args:
        path: of the file.
        upright: turned as EXIF says, without its alpha channel; otherwise as it is stored.

    Raises:
        ValueError: as photo_size, or the photo is damaged.
    """
    picture = _open(path)
    try:
        pixels = decode_upright(picture) if upright else decode_with_alpha(picture)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return cv2.convertScaleAbs(pixels, alpha=255 / 65535) if picture.bits == 16 else pixels


def _open(path: Path) -> Picture:
    try:
        return read_header(read_regular(path, _MAX_BYTES))
    except FileNotFoundError as error:
        raise ValueError(f"{path}: is missing") from error
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
