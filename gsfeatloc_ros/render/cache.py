"""Prepared maps kept in files beside the maps: reading one takes a fraction of the time of preparing it again."""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import math
import os
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsfeatloc_ros.common.kernel_cache import hash_of_sources
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.maps import MapError, Similarity, load_map
from gsfeatloc_ros.render.prepare import PreparedMap, prepare

SUFFIX = ".gsfeatloc-cache"

_log = logging.getLogger(__name__)

# A cache is this line, the CRC-32 of all that follows the next number (4 bytes), the length of the header (4 bytes,
# both little-endian), the header (JSON) and the arrays one after another.
_MAGIC = b"gsfeatloc_ros prepared map\n"
_ARRAYS = ("gaussians", "sh", "low", "high")
_MAX_HEADER_BYTES = 64 * 1024
# Of a map's content so many blocks are hashed, spread evenly. Size and time alone may be those of another map: images
# of containers and archives set all times to the same. To hash it all takes reading it all, which the cache is to save.
_SAMPLES, _SAMPLE_BYTES = 64, 4096
# An unbundled .sog is the files of these kinds in its folder.
_SOG_SUFFIXES = (".json", ".webp")


class _CacheError(Exception):
    """A file is no cache, or a damaged one."""


def load_prepared(
    path: str | Path, alignment: Similarity | None = None, cache_path: str | Path | None = None
) -> PreparedMap:
    """Read a map prepared from its cache; where there is none for it, load and prepare it, and write the cache.

    Args:
        path: the map, as for load_map.
        alignment: the map's S_map_splat; it is no part of the cache.
        cache_path: file of the cache; None for the map's name and SUFFIX, in the same folder. That it cannot be
            written is no error.

    Raises:
        MapError: the map cannot be used.
    """
    path = Path(path)
    absolute = Path(os.path.abspath(path))
    cache_path = absolute.with_name(absolute.name + SUFFIX) if cache_path is None else Path(cache_path)
    origin = {"code": _code(), "files": [_identity(file) for file in _map_files(absolute)]}
    prepared = _read_if_usable(cache_path, origin)
    if prepared is None:
        prepared = prepare(load_map(path))
        _write_if_possible(cache_path, prepared, origin)
    return prepared if alignment is None else replace(prepared, S_map_splat=alignment)


def _read_if_usable(path: Path, origin: dict[str, Any]) -> PreparedMap | None:
    """Return the map in a cache; None where there is no cache of a map of this `origin`."""
    try:
        with path.open("rb") as stream:
            return _read(stream, origin)
    except FileNotFoundError:
        return None
    except (OSError, _CacheError) as error:
        _log.warning("%s: %s: ignored, the map is prepared again", path, error)
        return None


def _read(stream: BinaryIO, origin: dict[str, Any]) -> PreparedMap | None:
    if stream.read(len(_MAGIC)) != _MAGIC:
        raise _CacheError("is no prepared map")
    checksum, length = (int.from_bytes(stream.read(4), "little") for _ in range(2))
    if length > _MAX_HEADER_BYTES:
        raise _CacheError("is damaged")
    encoded = stream.read(length)
    try:
        header = json.loads(encoded)
        if header["origin"] != origin:
            return None
        layout = {name: (np.dtype(dtype), shape) for name, (dtype, shape) in header["arrays"].items()}
        size = sum(dtype.itemsize * math.prod(shape) for dtype, shape in layout.values())
        if size != os.fstat(stream.fileno()).st_size - stream.tell():
            raise _CacheError("is truncated")
        arrays = {
            name: np.fromfile(stream, dtype, math.prod(shape)).reshape(shape) for name, (dtype, shape) in layout.items()
        }
        if _checksum(encoded, arrays) != checksum:
            raise _CacheError("is damaged")
        gaussians, sh, low, high = (arrays[name] for name in _ARRAYS)
        return PreparedMap(gaussians, sh, low, high, antialiased=header["antialiased"])
    except (KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise _CacheError("is damaged") from error


def _write_if_possible(path: Path, prepared: PreparedMap, origin: dict[str, Any]) -> None:
    """Write a cache; that it cannot be written is no error."""
    try:
        with replaced_file(path) as stream:
            _write(stream, prepared, origin)
    except OSError as error:
        _log.debug("%s: cannot be written: %s", path, error.strerror)


def _write(stream: BinaryIO, prepared: PreparedMap, origin: dict[str, Any]) -> None:
    arrays: dict[str, np.ndarray] = {name: getattr(prepared, name) for name in _ARRAYS}
    layout = {name: (array.dtype.str, array.shape) for name, array in arrays.items()}
    encoded = json.dumps({"origin": origin, "antialiased": prepared.antialiased, "arrays": layout}).encode()
    stream.write(_MAGIC)
    for number in (_checksum(encoded, arrays), len(encoded)):
        stream.write(number.to_bytes(4, "little"))
    stream.write(encoded)
    for array in arrays.values():
        array.tofile(stream)


def _checksum(header: bytes, arrays: dict[str, np.ndarray]) -> int:
    checksum = zlib.crc32(header)
    for array in arrays.values():
        checksum = zlib.crc32(array.data, checksum)
    return checksum


def map_content(path: str | Path) -> list[Any]:
    """Return what tells the content of a map from that of others: size and a hash of a sample of each of its files.

    It is the same for a copy under another name.

    Raises:
        MapError: the map cannot be read.
    """
    files = _map_files(Path(os.path.abspath(path)))
    if not files:
        raise MapError(f"{path}: cannot be read: there is no such map")
    return [[identity[1], identity[3]] for identity in map(_identity, files)]


def _map_files(path: Path) -> list[Path]:
    """Return the files that a map consists of; raise MapError where they cannot be listed."""
    folder = path if path.is_dir() else path.parent if path.suffix == ".json" else None
    try:
        files = [path] if folder is None else sorted(file for file in folder.iterdir() if file.suffix in _SOG_SUFFIXES)
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {error.strerror or error}") from error
    return [file for file in files if file.is_file()]


def _identity(file: Path) -> list[Any]:
    """Return name, size in bytes, time of the last change and a hash of a sample of the content.

    Raises:
        MapError: the file cannot be read.
    """
    digest = hashlib.sha256()
    try:
        status = file.stat()
        last = max(status.st_size - _SAMPLE_BYTES, 0)
        with file.open("rb") as stream:
            for sample in range(_SAMPLES):
                stream.seek(last * sample // (_SAMPLES - 1))
                digest.update(stream.read(_SAMPLE_BYTES))
    except OSError as error:
        raise MapError(f"{file}: cannot be read: {error.strerror or error}") from error
    return [file.name, status.st_size, status.st_mtime_ns, digest.hexdigest()]


@functools.cache
def _code() -> str:
    """Return the version of the code that reads and prepares maps; all that may have a part in that counts."""
    return hash_of_sources("maps", "render")
