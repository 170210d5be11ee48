"""The files of a COLMAP model, checked and without the points, of which nothing is used here.

pycolmap takes the memory that a count declares, and reads as often as it says, whatever the size of the file. So each
count is held against the bytes that are there. Layout: https://colmap.github.io/format.html#sparse-reconstruction
"""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Callable
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

from gsfeatloc_ros.common.safe_files import open_regular

_MAX_NAME_BYTES = 4096
# Doubles of a pose, a quaternion and a translation.
_POSE_BYTES = 56
_NO_POINTS = struct.pack("<Q", 0)


class _Reader:
    """Reads what COLMAP writes; raises ValueError where a file ends too early."""

    def __init__(self, stream: BufferedReader) -> None:
        self._stream = stream
        self._size = os.fstat(stream.fileno()).st_size

    def take(self, count: int) -> bytes:
        """Return so many bytes, and go on behind them."""
        if count > self._size - self._stream.tell():
            raise ValueError("is truncated, or claims more than it holds")
        return self._stream.read(count)

    def number(self, format: str) -> int:
        """Return a number."""
        return struct.unpack(f"<{format}", self.take(struct.calcsize(f"<{format}")))[0]

    def count(self, least: int) -> int:
        """Return a number of things that take at least so many bytes each."""
        count = self.number("Q")
        if count * least > self._size - self._stream.tell():
            raise ValueError(f"claims {count} entries, which are not in it")
        return count

    def skip(self, count: int, size: int) -> None:
        """Go on behind `count` things of `size` bytes."""
        if count * size > self._size - self._stream.tell():
            raise ValueError(f"claims {count} entries, which are not in it")
        self._stream.seek(count * size, os.SEEK_CUR)

    def name(self) -> bytes:
        """Return a name, with the zero at its end."""
        start = self._stream.tell()
        name, end, _ = self._stream.read(_MAX_NAME_BYTES).partition(b"\0")
        if not end:
            raise ValueError("has a name without an end")
        self._stream.seek(start + len(name) + 1)
        return name + end


def copy_without_points(path: Path, target: Path, parameters: Callable[[int], int]) -> None:
    """Copy the model in a folder, binary or text, to another one, without its points.

    Args:
        path: folder of the model.
        target: folder.
        parameters: returns the number of parameters of a camera model of COLMAP by its number; ValueError if unknown.

    Raises:
        ValueError: a file claims to hold more than it does.
        OSError: one cannot be read, or written.
    """
    if (path / "cameras.bin").exists():
        for name in ("cameras", "images", "rigs", "frames"):
            if name in ("cameras", "images") or (path / f"{name}.bin").exists():
                with open_regular(path / f"{name}.bin") as source, (target / f"{name}.bin").open("wb") as copy:
                    _copy_binary(name, source, copy, parameters)
        (target / "points3D.bin").write_bytes(_NO_POINTS)
        return
    for name in ("cameras", "rigs", "frames"):
        if name == "cameras" or (path / f"{name}.txt").exists():
            with open_regular(path / f"{name}.txt") as source, (target / f"{name}.txt").open("wb") as copy:
                shutil.copyfileobj(source, copy)
    with open_regular(path / "images.txt") as source, (target / "images.txt").open("wb") as copy:
        _copy_images_text(source, copy)
    (target / "points3D.txt").touch()


def _copy_binary(name: str, source: BufferedReader, copy: BinaryIO, parameters: Callable[[int], int]) -> None:
    reader = _Reader(source)
    try:
        if name == "images":
            _copy_images(reader, copy)
            return
        if name == "cameras":
            for _ in range(reader.count(24)):
                reader.skip(1, 4)
                model = reader.number("i")
                reader.skip(1, 16 + 8 * parameters(model))
        elif name == "rigs":
            for _ in range(reader.count(8)):
                reader.skip(1, 4)
                _skip_sensors(reader, reader.number("I"))
        else:
            for _ in range(reader.count(12 + _POSE_BYTES)):
                reader.skip(1, 8 + _POSE_BYTES)
                reader.skip(reader.number("I"), 16)
    except ValueError as error:
        raise ValueError(f"{name}.bin {error}") from error
    source.seek(0)
    shutil.copyfileobj(source, copy)


def _skip_sensors(reader: _Reader, sensors: int) -> None:
    """Skip the sensors of a rig: the first has no pose, the others perhaps one."""
    for sensor in range(sensors):
        reader.skip(1, 8)
        if sensor and reader.number("B"):
            reader.skip(1, _POSE_BYTES)


def _copy_images(reader: _Reader, copy: BinaryIO) -> None:
    count = reader.count(4 + _POSE_BYTES + 4 + 1 + 8)
    copy.write(struct.pack("<Q", count))
    for _ in range(count):
        copy.write(reader.take(4 + _POSE_BYTES + 4))
        copy.write(reader.name())
        reader.skip(reader.number("Q"), 24)
        copy.write(_NO_POINTS)


def _copy_images_text(source: BufferedReader, copy: BinaryIO) -> None:
    """Copy every first line of two; the other holds the image's points."""
    is_image = True
    for line in source:
        if line.startswith(b"#"):
            continue
        if is_image and not line.strip():
            continue
        copy.write(line if is_image else b"\n")
        is_image = not is_image
