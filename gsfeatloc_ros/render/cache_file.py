"""Prepared maps in files: written once, then read, the Gaussians of large ones as they are needed.

A file is a line of text; the header's length, the CRC-32 of the header and those of the arrays (4 bytes each,
little-endian); the header (JSON, filled up with spaces to the end of a page); and the arrays one after another. Only
what no other user can have written is read: the checksums tell damage, no more.
"""

from __future__ import annotations

import json
import math
import os
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, BinaryIO

import numpy as np

from gsfeatloc_ros.maps import Reading, Similarity
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS
from gsfeatloc_ros.render.chunks import (
    CHUNK,
    LARGE_MAP,
    LOG2_OPACITY,
    MAX_LOG2_OPACITY,
    MEAN_X,
    MEAN_Z,
    ROWS,
    PreparedMap,
    level_starts,
)
from gsfeatloc_ros.render.stored import StoredArray, StoredFile

MAGIC = b"gsfeatloc_ros prepared map 3\n"
ARRAYS = ("gaussians", "sh", "low", "high", "sizes")
_CHECKSUMS = 1 + len(ARRAYS)
# Gaussians of a map of 1 TB; more chunks are a lie.
_MAX_CHUNKS = 2**32 // CHUNK
_MAX_HEADER_BYTES = 64 * 1024
# Arrays begin with one.
_PAGE = 4096
# Of an array that is looked at, at a time.
_BLOCK_BYTES = 1 << 24
# All ones in a half: infinite, or no number.
_HALF_EXPONENT = np.uint16(0x7C00)
# Of a large map these stay in the file.
_STORED = ("gaussians", "sh")


class CacheError(Exception):
    """A file is no cache, or a damaged one."""


@dataclass(frozen=True)
class Header:
    """What there is to know of a prepared map but its arrays.

    Attributes:
        leaves: chunks of the finest level.
        coarser: whether there are other levels.
        sh_coefficients: spherical harmonics per colour channel.
        antialiased, reading: as in PreparedMap.
        offset: (3,) where the splat frame's origin lies in the file's.
    """

    leaves: int
    coarser: bool
    sh_coefficients: int
    antialiased: bool
    offset: tuple[float, ...]
    reading: Reading

    @staticmethod
    def of(prepared: PreparedMap) -> Header:
        """Return that of a map."""
        return Header(
            leaves=prepared.leaves,
            coarser=len(prepared.sizes) > prepared.leaves,
            sh_coefficients=prepared.sh_coefficients,
            antialiased=prepared.antialiased,
            offset=tuple(prepared.S_map_splat.translation.tolist()),
            reading=prepared.reading,
        )

    @staticmethod
    def parse(values: dict[str, Any]) -> Header:
        """Return what the JSON of a file says; raise CacheError where it cannot be so."""
        try:
            said = values["reading"]
            reading = Reading(tuple(said["notes"]), said["left_out"], said["other"])
            header = Header(**values | {"reading": reading, "offset": tuple(values["offset"])})
            Similarity(translation=np.array(header.offset))
            known = type(header.leaves) is type(header.sh_coefficients) is int
            known &= type(header.coarser) is type(header.antialiased) is bool
            known &= 0 <= header.leaves <= _MAX_CHUNKS and header.sh_coefficients in SH_COEFFICIENTS
        except (KeyError, TypeError, ValueError) as error:
            raise CacheError("is damaged") from error
        if not known:
            raise CacheError("is damaged")
        return header

    def layout(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Return type and shape of each of the ARRAYS, in the order of the file."""
        chunks = int(level_starts(self.leaves, self.coarser)[-1])
        return {
            "gaussians": ("<f4", (chunks, ROWS, CHUNK)),
            "sh": ("<f2", (chunks, 3 * self.sh_coefficients, CHUNK)),
            "low": ("<f4", (chunks, 3)),
            "high": ("<f4", (chunks, 3)),
            "sizes": ("<f4", (chunks,)),
        }

    def size(self) -> int:
        """Return the bytes of all arrays."""
        return sum(_size(*array) for array in self.layout().values())

    def prepared(self, arrays: Mapping[str, Any]) -> PreparedMap:
        """Return the map of these arrays."""
        return PreparedMap(
            **arrays,
            leaves=self.leaves,
            antialiased=self.antialiased,
            S_map_splat=Similarity(translation=np.array(self.offset)),
            reading=self.reading,
        )


def write(stream: BinaryIO, prepared: PreparedMap, origin: dict[str, Any]) -> None:
    """Write a map to a file that can be read as well; raise OSError where that fails."""
    copy = create(stream, Header.of(prepared), origin)
    for name in ARRAYS:
        getattr(copy, name)[:] = getattr(prepared, name)[:]
    seal(stream, copy)


def create(stream: BinaryIO, header: Header, origin: dict[str, Any]) -> PreparedMap:
    """Return a map, all zeros, whose Gaussians are in a file; it is whole once it is sealed.

    Raises:
        OSError: there is no room for it.
    """
    encoded = json.dumps({"origin": origin, "map": asdict(header)}).encode()
    fixed = len(MAGIC) + 4 * (1 + _CHECKSUMS)
    encoded += b" " * (-(fixed + len(encoded)) % _PAGE)
    stream.write(MAGIC)
    stream.write(len(encoded).to_bytes(4, "little"))
    stream.write(zlib.crc32(encoded).to_bytes(4, "little"))
    stream.write(bytes(4 * len(ARRAYS)))
    stream.write(encoded)
    stream.flush()
    if header.size():
        # Now, not after minutes of work.
        os.posix_fallocate(stream.fileno(), fixed + len(encoded), header.size())
    arrays = _arrays(stream, header, fixed + len(encoded))
    small = {name: np.zeros(array.shape, array.dtype) for name, array in arrays.items() if name not in _STORED}
    return header.prepared(arrays | small)


def seal(stream: BinaryIO, prepared: PreparedMap) -> None:
    """Write what is left of a map that `create` made in a file: its small arrays, and the checksums."""
    header = Header.of(prepared)
    checksums = b""
    for name, array in _arrays(stream, header, os.fstat(stream.fileno()).st_size - header.size()).items():
        if name not in _STORED:
            array[:] = getattr(prepared, name)
        checksum = 0
        for block in array.blocks(_BLOCK_BYTES):
            checksum = zlib.crc32(block.data, checksum)
        checksums += checksum.to_bytes(4, "little")
    stream.seek(len(MAGIC) + 8)
    stream.write(checksums)


def read(stream: BinaryIO, origin: dict[str, Any], large: int = LARGE_MAP) -> PreparedMap | None:
    """Read a map; of one of more than `large` Gaussians these stay in the file.

    All of it is looked at once. What a view needs then comes from the disk, or from what the system keeps of the file
    while there is memory to spare; several processes share that. The file must not be changed, only replaced.

    Returns:
        The map; None where the file is of another `origin`.

    Raises:
        CacheError: it is no prepared map, or a damaged one.
        OSError: it cannot be read.
    """
    status = os.fstat(stream.fileno())
    if stream.read(len(MAGIC)) != MAGIC:
        raise CacheError("is no prepared map of this version")
    length, *checksums = (int.from_bytes(stream.read(4), "little") for _ in range(1 + _CHECKSUMS))
    if length > _MAX_HEADER_BYTES:
        raise CacheError("is damaged")
    encoded = stream.read(length)
    try:
        values = json.loads(encoded)
        if values["origin"] != origin:
            return None
        header = Header.parse(values["map"])
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CacheError("is damaged") from error
    start, is_large = stream.tell(), header.leaves * CHUNK > large
    if header.size() != status.st_size - start:
        raise CacheError("is truncated")
    # One that large without coarser levels would be drawn from more chunks than there is memory for.
    if zlib.crc32(encoded) != checksums[0] or (is_large and not header.coarser):
        raise CacheError("is damaged")
    arrays: dict[str, np.ndarray | StoredArray] = {}
    for (name, array), checksum in zip(_arrays(stream, header, start, status).items(), checksums[1:], strict=True):
        stays = is_large and name in _STORED
        found = 0
        for block in array.blocks(_BLOCK_BYTES if stays else header.size()):
            found = zlib.crc32(block.data, found)
            if not _is_possible(name, block):
                raise CacheError("is damaged")
            arrays[name] = array if stays else block
        if found != checksum:
            raise CacheError("is damaged")
    return header.prepared(arrays)


def _size(dtype: str, shape: tuple[int, ...]) -> int:
    """Return the bytes of an array."""
    return np.dtype(dtype).itemsize * math.prod(shape)


def _arrays(
    stream: BinaryIO, header: Header, start: int, status: os.stat_result | None = None
) -> dict[str, StoredArray]:
    """Return the ARRAYS that are in a file from `start` on; `status` as for StoredFile."""
    file, arrays = StoredFile(stream, status), {}
    for name, (dtype, shape) in header.layout().items():
        arrays[name] = StoredArray(file, start, dtype, shape)
        start += _size(dtype, shape)
    return arrays


def _is_possible(name: str, array: np.ndarray) -> bool:
    """Return whether all values are such as `prepare` makes of a map: of finite Gaussians, none too opaque."""
    if name == "gaussians":
        means, opacities = array[:, MEAN_X : MEAN_Z + 1], array[:, LOG2_OPACITY]
        return bool(np.isfinite(means).all() and (opacities <= MAX_LOG2_OPACITY).all())
    if name == "sh":
        # By their bits, which takes a third of the time of isfinite.
        return bool(((array.view(np.uint16) & _HALF_EXPONENT) != _HALF_EXPONENT).all())
    return True
