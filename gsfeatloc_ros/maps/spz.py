"""Maps as .spz, the format of Niantic: fixed-point values, gzip (versions 1 to 3) or zstd (version 4).

Layout: https://github.com/nianticlabs/spz (README.md, load-spz.cc, splat-utils.h)
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from backports import zstd

from gsfeatloc_ros.maps.assemble import Block, assemble, block_slices, check_compression, check_count, read_packed
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap, MapError

_ANTIALIASED, _HAS_EXTENSIONS = 1, 2
_COLOR_SCALE = 0.15
# The one extension that changes what the values mean; the others are for viewers.
_COORDINATE_SYSTEM_EXTENSION, _RUB = 0xADBE0003, 4
# The file's axes are x right, y up, z back; those of the .ply it was made from x right, y down, z front. The half turn
# about x between them changes the sign of the harmonics with an odd power of y and z.
_HALF_TURN = np.array([1, -1, -1], np.float32)
_SH_HALF_TURN = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int

    @property
    def stream_sizes(self) -> list[int]:
        """Number of bytes of positions, opacities, colours, scales, rotations and harmonics."""
        position, rotation = 6 if self.version == 1 else 9, 4 if self.version >= 3 else 3
        return [self.count * n for n in (position, 1, 3, 3, rotation, 3 * (SH_COEFFICIENTS[self.sh_degree] - 1))]


def read_spz(path: Path) -> GaussianMap:
    """Read a map from an .spz file of version 1 to 4 and turn it to the axes of the .ply that it was made from.

    Raises:
        MapError: the file is truncated, damaged or of another version.
        OSError: it cannot be read.
    """
    content = read_packed(path, path)
    unpack = _inflate if content.startswith(b"\x1f\x8b") else _decompress_zstd
    try:
        header, streams = unpack(path, content)
    except (zlib.error, zstd.ZstdError, EOFError) as error:
        raise MapError(f"{path}: is damaged: {error}") from error
    del content
    blocks = _blocks(header, streams)
    return assemble(path, header.count, SH_COEFFICIENTS[header.sh_degree], blocks, bool(header.flags & _ANTIALIASED))


def _parse_header(path: Path, head: bytes, versions: range, file_size: int) -> _Header:
    if len(head) < 16 or head[:4] != b"NGSP":
        raise MapError(f"{path}: is gzip, but no .spz is in it" if len(head) == 16 else f"{path}: is truncated")
    header = _Header(*struct.unpack("<IIBBB", head[4:15]))
    if header.version not in versions:
        raise MapError(f"{path}: is an .spz of version {header.version}, which is not read: export version 2, 3 or 4")
    if header.sh_degree >= len(SH_COEFFICIENTS):
        raise MapError(f"{path}: has spherical harmonics of degree {header.sh_degree}; those of 0 to 3 are read")
    if header.fractional_bits > 24:
        raise MapError(f"{path}: is damaged: {header.fractional_bits} fractional bits in positions of 24")
    check_count(path, header.count)
    check_compression(path, sum(header.stream_sizes), file_size)
    return header


def _inflate(path: Path, content: bytes) -> tuple[_Header, list[bytes]]:
    """Unpack versions 1 to 3: one gzip of the header and the streams, one after the other."""
    inflater = zlib.decompressobj(16 + zlib.MAX_WBITS)
    header = _parse_header(path, inflater.decompress(content, 16), range(1, 4), len(content))
    size = sum(header.stream_sizes)
    payload = inflater.decompress(inflater.unconsumed_tail, size)
    extensions = inflater.decompress(inflater.unconsumed_tail, 1 << 20)
    if len(payload) < size or not inflater.eof:
        raise MapError(f"{path}: is truncated or damaged: it does not unpack to {header.count} Gaussians")
    _check_extensions(path, header, extensions)
    ends = np.cumsum(header.stream_sizes)
    view = memoryview(payload)
    return header, [view[end - n : end] for n, end in zip(header.stream_sizes, ends, strict=True)]


def _decompress_zstd(path: Path, content: bytes) -> tuple[_Header, list[bytes]]:
    """Unpack version 4: header, extensions, table of stream sizes, and each stream compressed by itself."""
    header = _parse_header(path, content[:16], range(4, 5), len(content))
    sizes = [size for size in header.stream_sizes if size]
    if len(content) < 32:
        raise MapError(f"{path}: is truncated")
    table = int.from_bytes(content[16:20], "little")
    start = table + 16 * len(sizes)
    if content[15] != len(sizes) or table < 32 or start > len(content):
        raise MapError(f"{path}: is truncated, or its table of {content[15]} streams at byte {table} is damaged")
    _check_extensions(path, header, content[32:table])
    streams = []
    for index, size in enumerate(sizes):
        compressed_size, claimed_size = struct.unpack_from("<QQ", content, table + 16 * index)
        end = start + compressed_size
        if end > len(content) or claimed_size != size:
            raise MapError(f"{path}: is truncated or damaged: stream {index} of {compressed_size} bytes ends at {end}")
        # A frame may ask for no more memory than the stream takes.
        window: dict[int, int] = {zstd.DecompressionParameter.window_log_max: min(max(size.bit_length(), 10), 31)}
        decompressor = zstd.ZstdDecompressor(options=window)
        streams.append(decompressor.decompress(memoryview(content)[start:end], size + 1))
        if len(streams[-1]) != size or not decompressor.eof:
            raise MapError(f"{path}: is damaged: stream {index} does not unpack to {size} bytes")
        start = end
    return header, [*streams, *[b""] * (6 - len(sizes))]


def _check_extensions(path: Path, header: _Header, records: bytes) -> None:
    """Refuse other axes than .spz's own, which an extension may declare: (type, size, content) one after another."""
    if not header.flags & _HAS_EXTENSIONS:
        return
    while records:
        if len(records) < 8:
            raise MapError(f"{path}: is damaged: an extension record is cut off")
        kind, size = struct.unpack_from("<II", records)
        if kind == _COORDINATE_SYSTEM_EXTENSION and records[8 : 8 + size] != struct.pack("<I", _RUB):
            raise MapError(f"{path}: declares axes other than right-up-back, which are not read: export it with those")
        records = records[8 + size :]


def _blocks(header: _Header, streams: list[bytes]) -> Iterator[Block]:
    """Decode runs of Gaussians of the six streams."""
    positions, opacities, colors, scales, rotations, harmonics = (
        np.frombuffer(stream, np.uint8).reshape(header.count, -1) for stream in streams
    )
    for rows in block_slices(header.count):
        sh0 = (colors[rows] / np.float32(255.0) - 0.5) / _COLOR_SCALE
        sh = np.concatenate([sh0, (harmonics[rows] - np.float32(128.0)) / 128.0], axis=1).reshape(len(sh0), -1, 3)
        decode_rotations = _smallest_three if header.version >= 3 else _first_three
        yield Block(
            means=_positions(positions[rows], header) * _HALF_TURN,
            scales=np.exp(scales[rows] / np.float32(16.0) - 10.0),
            rotations=decode_rotations(rotations[rows]) * np.array([1, *_HALF_TURN], np.float32),
            opacities=opacities[rows, 0] / np.float32(255.0),
            sh=sh * _SH_HALF_TURN[: sh.shape[1], None],
        )


def _positions(packed: np.ndarray, header: _Header) -> np.ndarray:
    """Decode positions (n, 3) of (n, 9) bytes, three fixed-point numbers of 24 bits; in version 1 of 6, half floats."""
    if header.version == 1:
        return packed.reshape(-1, 3, 2).view("<f2")[..., 0].astype(np.float32)
    low, middle, high = np.moveaxis(packed.reshape(-1, 3, 3), -1, 0)
    fixed = (low | middle.astype(np.int32) << 8) + (high.astype(np.int8).astype(np.int32) << 16)
    return fixed.astype(np.float32) / np.float32(1 << header.fractional_bits)


def _first_three(packed: np.ndarray) -> np.ndarray:
    """Decode quaternions (n, 4) wxyz of (n, 3) bytes: x, y, z of a unit quaternion with w >= 0."""
    xyz = packed / np.float32(127.5) - 1.0
    w = np.sqrt(np.maximum(1.0 - np.sum(xyz * xyz, axis=1), 0.0))
    return np.concatenate([w[:, None], xyz], axis=1)


def _smallest_three(packed: np.ndarray) -> np.ndarray:
    """Decode quaternions (n, 4) wxyz of (n, 4) bytes, a number of 32 bits.

    The two highest bits tell the largest component of xyzw; the others follow in order, each with a sign and 9 bits.
    """
    bits = np.ascontiguousarray(packed).view("<u4")[:, 0]
    largest = bits >> 30
    fields = (bits[:, None] >> np.array([20, 10, 0], np.uint32)) & 1023
    three = (fields & 511).astype(np.float32) * np.float32(np.sqrt(0.5) / 511.0)
    three[fields >= 512] *= -1.0
    xyzw = np.empty((len(bits), 4), np.float32)
    columns = np.arange(3) + (np.arange(3) >= largest[:, None])
    np.put_along_axis(xyzw, columns, three, axis=1)
    rest = np.sqrt(np.maximum(1.0 - np.sum(three * three, axis=1), 0.0))
    np.put_along_axis(xyzw, largest[:, None].astype(np.intp), rest[:, None], axis=1)
    return np.roll(xyzw, 1, axis=1)
