"""Which files a map consists of, by the path that a user gives."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import Any

from gsfeatloc_ros.common.safe_files import open_regular
from gsfeatloc_ros.maps.gaussian_map import MapError

META, LOD_META = "meta.json", "lod-meta.json"
# Of a folder with a meta.json or lod-meta.json, files of these kinds are the map.
_PART_SUFFIXES = (".json", ".webp", ".png", ".npz")


def find_map(path: Path) -> Path:
    """Return the file that tells what a map is: the file itself, or that in a folder; a folder without one as it is.

    Of a folder of the INRIA trainer's output that is the .ply of the latest iteration.

    Raises:
        OSError: the folder cannot be read.
    """
    if not path.is_dir():
        return path
    for name in (META, LOD_META):
        if (path / name).is_file():
            return path / name
    found = [*path.glob("point_cloud/iteration_*/point_cloud.ply"), *path.glob("iteration_*/point_cloud.ply")]
    return max(found, key=iteration, default=path)


def iteration(ply: Path) -> int:
    """Return the number of the iteration whose folder a map of the INRIA trainer is in, -1 if it is in none."""
    number = re.fullmatch(r"iteration_(\d+)", ply.parent.name)
    return int(number[1]) if number else -1


def map_files(path: Path) -> list[Path]:
    """Return the files that a map consists of, none where there is no such map.

    Raises:
        MapError: they cannot be listed.
    """
    try:
        main = find_map(path)
        if main.suffix == ".json":
            parts = main.parent.rglob("*") if main.name == LOD_META else main.parent.iterdir()
            return sorted(file for file in parts if file.suffix in _PART_SUFFIXES and file.is_file())
        return [main] if main.is_file() else []
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {error.strerror or error}") from error


def content_of(file: Path) -> list[Any]:
    """Return the size in bytes and the SHA-256 of a file: 0.15 s for a map of a million Gaussians, 236 MB.

    Raises:
        MapError: the file cannot be read.
    """
    try:
        with open_regular(file) as stream:
            return [os.fstat(stream.fileno()).st_size, hashlib.file_digest(stream, "sha256").hexdigest()]
    except OSError as error:
        raise MapError(f"{file}: cannot be read: {error.strerror or error}") from error
