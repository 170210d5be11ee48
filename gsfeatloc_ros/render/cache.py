"""Prepared maps kept in files beside the maps: reading one takes a fraction of the time of preparing it again."""

from __future__ import annotations

import functools
import json
import logging
import math
import os
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsfeatloc_ros.common.kernel_cache import hash_of_sources
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.common.safe_files import open_own
from gsfeatloc_ros.maps import MapError, Reading, ReadOptions, Similarity, load_map
from gsfeatloc_ros.maps.bundle import read_bundle
from gsfeatloc_ros.maps.files import content_of, map_files
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS
from gsfeatloc_ros.render.prepare import CHUNK, LOG2_OPACITY, MEAN_X, MEAN_Z, ROWS, PreparedMap, prepare

SUFFIX = ".gsfeatloc-cache"

_log = logging.getLogger(__name__)

_DEFAULT_OPTIONS = ReadOptions()

# Only what no other user can have written is read: the checksum tells damage, no more. A cache is this line, the CRC-32
# of all that follows the next number (4 bytes), the header's length (4 bytes, both little-endian), the header (JSON)
# and the arrays one after another.
_MAGIC = b"gsfeatloc_ros prepared map 2\n"
# Gaussians of a map of 1 TB; more chunks are a lie.
_MAX_CHUNKS = 2**32 // CHUNK
_MAX_HEADER_BYTES = 64 * 1024
# All ones in a half: infinite, or no number.
_HALF_EXPONENT = np.uint16(0x7C00)


class _CacheError(Exception):
    """A file is no cache, or a damaged one."""


def load_prepared(
    path: str | Path,
    alignment: Similarity | None = None,
    options: ReadOptions = _DEFAULT_OPTIONS,
    cache_path: str | Path | None = None,
) -> PreparedMap:
    """Read a map prepared from its cache; where there is none for it, load and prepare it, and write the cache.

    Args:
        path, options: as for load_map.
        alignment: as for load_map; it is no part of the cache.
        cache_path: file of the cache; None for the map's name and SUFFIX, in the same folder; of a bundle, in it. That
            it cannot be written is no error.

    Raises:
        MapError: the map cannot be used.
    """
    bundle = read_bundle(path)
    path = Path(path) if bundle is None else bundle.map
    absolute = Path(os.path.abspath(path))
    cache_path = absolute.with_name(absolute.name + SUFFIX) if cache_path is None else Path(cache_path)
    content = [content_of(file) for file in map_files(absolute)]
    if bundle is not None:
        bundle.check_map(content)
    origin = {"code": _code(), "map": content, "options": asdict(options)}
    prepared = _read_if_usable(cache_path, origin)
    if prepared is None:
        prepared = prepare(load_map(path, options=options))
        _write_if_possible(cache_path, prepared, origin)
    return prepared if alignment is None else prepared.placed(alignment)


def _read_if_usable(path: Path, origin: dict[str, Any]) -> PreparedMap | None:
    """Return the map in a cache; None where there is no cache of a map of this `origin`."""
    try:
        with open_own(path) as stream:
            return _read(stream, origin)
    except FileNotFoundError:
        return None
    except (OSError, _CacheError) as error:
        _log.warning("%s: %s: ignored, the map is prepared again", path, error)
        return None


def _read(stream: BinaryIO, origin: dict[str, Any]) -> PreparedMap | None:
    if stream.read(len(_MAGIC)) != _MAGIC:
        raise _CacheError("is no prepared map of this version")
    checksum, length = (int.from_bytes(stream.read(4), "little") for _ in range(2))
    if length > _MAX_HEADER_BYTES:
        raise _CacheError("is damaged")
    encoded = stream.read(length)
    try:
        header = json.loads(encoded)
        if header["origin"] != origin:
            return None
        chunks, coefficients, antialiased = (header[name] for name in ("chunks", "sh_coefficients", "antialiased"))
        offset = Similarity(translation=np.array(header["offset"]))
        reading = Reading(tuple(header["notes"]), header["left_out"], header["other"])
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise _CacheError("is damaged") from error
    known = type(chunks) is int and type(coefficients) is int and type(antialiased) is bool
    if not known or not 0 <= chunks <= _MAX_CHUNKS or coefficients not in SH_COEFFICIENTS:
        raise _CacheError("is damaged")
    layout = _layout(chunks, coefficients)
    size = sum(np.dtype(dtype).itemsize * math.prod(shape) for dtype, shape in layout.values())
    if size != os.fstat(stream.fileno()).st_size - stream.tell():
        raise _CacheError("is truncated")
    arrays = {
        name: np.fromfile(stream, dtype, math.prod(shape)).reshape(shape) for name, (dtype, shape) in layout.items()
    }
    prepared = PreparedMap(**arrays, antialiased=antialiased, S_map_splat=offset, reading=reading)
    if _checksum(encoded, arrays) != checksum or not _is_possible(prepared):
        raise _CacheError("is damaged")
    return prepared


def _layout(chunks: int, coefficients: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return type and shape of each array of a prepared map, in the order of the file."""
    return {
        "gaussians": ("<f4", (chunks, ROWS, CHUNK)),
        "sh": ("<f2", (chunks, 3 * coefficients, CHUNK)),
        "low": ("<f4", (chunks, 3)),
        "high": ("<f4", (chunks, 3)),
    }


def _is_possible(prepared: PreparedMap) -> bool:
    """Return whether all values are such as `prepare` makes of a map: of finite Gaussians, none more than opaque."""
    opacity = prepared.gaussians[:, LOG2_OPACITY]
    return bool(
        np.isfinite(prepared.gaussians[:, MEAN_X : MEAN_Z + 1]).all()
        and (opacity <= 0).all()
        # By their bits, which takes a third of the time of isfinite.
        and ((prepared.sh.view(np.uint16) & _HALF_EXPONENT) != _HALF_EXPONENT).all()
    )


def _write_if_possible(path: Path, prepared: PreparedMap, origin: dict[str, Any]) -> None:
    """Write a cache; that it cannot be written is no error."""
    try:
        with replaced_file(path) as stream:
            _write(stream, prepared, origin)
    except OSError as error:
        _log.debug("%s: cannot be written: %s", path, error.strerror)


def _write(stream: BinaryIO, prepared: PreparedMap, origin: dict[str, Any]) -> None:
    about: dict[str, Any] = {"chunks": len(prepared.gaussians), "sh_coefficients": prepared.sh_coefficients}
    arrays: dict[str, np.ndarray] = {name: getattr(prepared, name) for name in _layout(0, 1)}
    about |= {"antialiased": prepared.antialiased, "offset": prepared.S_map_splat.translation.tolist()}
    encoded = json.dumps({"origin": origin, **about, **asdict(prepared.reading)}).encode()
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
    """Return what tells the content of a map from that of others: size and SHA-256 of each of its files.

    It is the same for a copy under another name. Of a map in a bundle it is what the manifest says: those that load
    the map check it.

    Raises:
        MapError: the map cannot be read.
    """
    bundle = read_bundle(path)
    if bundle is not None:
        return bundle.map_content
    files = map_files(Path(os.path.abspath(path)))
    if not files:
        raise MapError(f"{path}: cannot be read: there is no such map")
    return [content_of(file) for file in files]


@functools.cache
def _code() -> str:
    """Return the version of the code that reads and prepares maps; all that may have a part in that counts."""
    return hash_of_sources("maps", "render")
