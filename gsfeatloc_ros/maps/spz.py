"""Maps as .spz, the format of Niantic: fixed-point values, gzip or plain (versions 1 to 3) or zstd (version 4).

Layout: https://github.com/nianticlabs/spz (README.md, extensions/README.md, load-spz.cc, splat-types.h)
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from backports import zstd

from gsfeatloc_ros.common.geometry import quaternion_from_matrix
from gsfeatloc_ros.maps.assemble import (
    Block,
    Gather,
    Layout,
    T,
    block_slices,
    check_compression,
    check_count,
    read_packed,
)
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, MapError
from gsfeatloc_ros.maps.harmonics import turned
from gsfeatloc_ros.maps.options import ReadOptions

_ANTIALIASED, _HAS_EXTENSIONS = 1, 2
_MAX_SH_DEGREE = 4
_COLOR_SCALE = 0.15
# Extensions: limits of a viewer's camera, which are of no use here, and axes.
_ORBIT_EXTENSION, _AXES_EXTENSION = 0xADBE0002, 0xADBE0003
# Axes by their number in the extension, from 1 on: where x, y and z point, left or right, down or up, back or front. A
# .ply has RDF, an .spz that declares nothing RUB.
_AXES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU")
_PLY, _DEFAULT = _AXES.index("RDF"), _AXES.index("RUB")
# Parameter map.spz_axes.
_CHOICES = {"ply": _PLY, "rub": _DEFAULT}


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
        return [self.count * n for n in (position, 1, 3, 3, rotation, 3 * ((self.sh_degree + 1) ** 2 - 1))]


@dataclass(frozen=True)
class _Extensions:
    """What the extensions say: the index of the axes in _AXES, if any, and the types of those that are not known."""

    axes: int | None = None
    unknown: tuple[int, ...] = ()


def read_spz(path: Path, options: ReadOptions, gather: Gather[T]) -> T:
    """Read a map from an .spz file of version 1 to 4 and turn it to the axes of the .ply that it was made from.

    Raises:
        MapError: the file is truncated, damaged or of another version.
        OSError: it cannot be read.
    """
    content = read_packed(path, path)
    zipped = content.startswith(b"\x1f\x8b")
    unpack = _inflate if zipped else _split if int.from_bytes(content[4:8], "little") < 4 else _decompress_zstd
    try:
        header, extensions, streams = unpack(path, content)
    except (zlib.error, zstd.ZstdError, EOFError) as error:
        raise MapError(f"{path}: is damaged: {error}") from error
    del content
    axes, notes, other = _choose_axes(extensions, options)
    if extensions.unknown:
        notes.append(f"extensions that are not known and not used: {', '.join(map(hex, extensions.unknown))}")
    if header.sh_degree >= len(SH_COEFFICIENTS):
        notes.append(f"spherical harmonics of degree {header.sh_degree} are read to degree 3")
    used = SH_COEFFICIENTS[min(header.sh_degree, len(SH_COEFFICIENTS) - 1)]
    layout = Layout(header.count, used, bool(header.flags & _ANTIALIASED), tuple(notes), other)
    return gather(path, layout, _blocks(header, streams, *_to_ply(axes)), options)


def _choose_axes(extensions: _Extensions, options: ReadOptions) -> tuple[int, list[str], str]:
    """Return the index of the file's axes in _AXES, what there is to say of them, and how else they may be meant."""
    declared = extensions.axes
    if options.spz_axes == "auto" and declared is None:
        return (
            _DEFAULT,
            [
                "the file does not say which axes it has: taken for right-up-back (RUB), the format's default. "
                "Programs that keep the .ply's axes (splat-transform 3.7, gsply 0.4.6) need map.spz_axes:=ply"
            ],
            "the .spz does not say which axes it has: if they are the .ply's, set map.spz_axes:=ply",
        )
    if declared is None:
        return _CHOICES[options.spz_axes], [], ""
    if options.spz_axes == "auto":
        return declared, [f"its axes are {_AXES[declared]}, as the file declares"], ""
    chosen = _CHOICES[options.spz_axes]
    differs = f"map.spz_axes is {options.spz_axes}, though the file declares {_AXES[declared]}"
    return chosen, [] if chosen == declared else [differs], ""


def _to_ply(axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return signs (3,) and then a rotation (3, 3) that bring points from axes of _AXES to those of a .ply (RDF).

    As the format's own library does it (coordinateConverter in splat-types.h), whose writers the declarations are from:
    bits of the number tell the signs along x, y and z, and the later eight are turned by -90 degrees about x.
    """
    signs = np.array([1.0 if (axes ^ _PLY) >> bit & 1 == 0 else -1.0 for bit in range(3)], np.float32)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return signs, turn if axes >= 8 else np.eye(3)


def _parse_header(path: Path, head: bytes, versions: range, file_size: int) -> _Header:
    if len(head) < 16 or head[:4] != b"NGSP":
        raise MapError(f"{path}: is gzip, but no .spz is in it" if len(head) == 16 else f"{path}: is truncated")
    header = _Header(*struct.unpack("<IIBBB", head[4:15]))
    if header.version not in versions:
        raise MapError(f"{path}: is an .spz of version {header.version}, which is not read: export version 2, 3 or 4")
    if header.sh_degree > _MAX_SH_DEGREE:
        raise MapError(f"{path}: is damaged: spherical harmonics of degree {header.sh_degree}; an .spz has 0 to 4")
    if unknown := header.flags & ~(_ANTIALIASED | _HAS_EXTENSIONS):
        raise MapError(f"{path}: has a flag {unknown:#x} that is not known: export it with an older program")
    if header.fractional_bits > 24:
        raise MapError(f"{path}: is damaged: {header.fractional_bits} fractional bits in positions of 24")
    check_count(path, header.count)
    check_compression(path, sum(header.stream_sizes), file_size)
    return header


def _inflate(path: Path, content: bytes) -> tuple[_Header, _Extensions, list[memoryview]]:
    """Unpack versions 1 to 3: one gzip of the header and the streams, one after the other."""
    inflater = zlib.decompressobj(16 + zlib.MAX_WBITS)
    header = _parse_header(path, inflater.decompress(content, 16), range(1, 4), len(content))
    payload = inflater.decompress(inflater.unconsumed_tail, sum(header.stream_sizes))
    extensions = inflater.decompress(inflater.unconsumed_tail, 1 << 20)
    if not inflater.eof:
        raise MapError(f"{path}: is truncated or damaged: it does not unpack to {header.count} Gaussians")
    return header, _parse_extensions(path, header, extensions), _streams(path, header, payload)


def _split(path: Path, content: bytes) -> tuple[_Header, _Extensions, list[memoryview]]:
    """Take versions 1 to 3 apart that are not compressed at all, as tests of some programs have them."""
    header = _parse_header(path, content[:16], range(1, 4), len(content))
    end = 16 + sum(header.stream_sizes)
    return header, _parse_extensions(path, header, content[end:]), _streams(path, header, content[16:end])


def _streams(path: Path, header: _Header, payload: bytes) -> list[memoryview]:
    """Return the six streams of versions 1 to 3."""
    if len(payload) < sum(header.stream_sizes):
        raise MapError(f"{path}: is truncated or damaged: it does not unpack to {header.count} Gaussians")
    ends, view = np.cumsum(header.stream_sizes), memoryview(payload)
    return [view[end - n : end] for n, end in zip(header.stream_sizes, ends, strict=True)]


def _decompress_zstd(path: Path, content: bytes) -> tuple[_Header, _Extensions, list[bytes]]:
    """Unpack version 4: header, extensions, table of stream sizes, and each stream compressed by itself."""
    header = _parse_header(path, content[:16], range(4, 5), len(content))
    sizes = [size for size in header.stream_sizes if size]
    if len(content) < 32:
        raise MapError(f"{path}: is truncated")
    table = int.from_bytes(content[16:20], "little")
    start = table + 16 * len(sizes)
    if content[15] != len(sizes) or table < 32 or start > len(content):
        raise MapError(f"{path}: is truncated, or its table of {content[15]} streams at byte {table} is damaged")
    if any(content[20:32]):
        raise MapError(f"{path}: sets bytes of the header that are reserved: export it with an older program")
    extensions = _parse_extensions(path, header, content[32:table])
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
    return header, extensions, [*streams, *[b""] * (6 - len(sizes))]


def _parse_extensions(path: Path, header: _Header, records: bytes) -> _Extensions:
    """Read the extensions: (type, size, content) one after another."""
    axes: int | None = None
    unknown = []
    while header.flags & _HAS_EXTENSIONS and records:
        kind, size = struct.unpack_from("<II", records) if len(records) >= 8 else (0, 0)
        content, records = records[8 : 8 + size], records[8 + size :]
        if len(content) < size or kind == 0:
            raise MapError(f"{path}: is damaged: an extension record is cut off")
        if kind == _AXES_EXTENSION:
            number = int.from_bytes(content, "little")
            if size != 4 or not 1 <= number <= len(_AXES):
                raise MapError(f"{path}: declares axes {number}, which is none of the 16: export it again")
            axes = number - 1
        elif kind != _ORBIT_EXTENSION:
            unknown.append(kind)
    return _Extensions(axes, tuple(unknown))


def _blocks(
    header: _Header, streams: list[bytes] | list[memoryview], signs: np.ndarray, turn: np.ndarray
) -> Iterator[Block]:
    """Decode runs of Gaussians of the six streams, and mirror and turn them as _to_ply says."""
    positions, opacities, colors, scales, rotations, harmonics = (
        np.frombuffer(stream, np.uint8).reshape(header.count, -1) for stream in streams
    )
    harmonics = harmonics[:, : 3 * (SH_COEFFICIENTS[-1] - 1)]
    used = 1 + harmonics.shape[1] // 3
    coefficients = turned(turn @ np.diag(signs))[:used, :used]
    # A Gaussian is the same mirrored along its own axes: with these mirrored too, a rotation stays one.
    flips = np.array([1.0, *(np.prod(signs) * signs)], np.float32)
    quaternion = np.roll(quaternion_from_matrix(turn), 1)
    decode_rotations = _smallest_three if header.version >= 3 else _first_three
    for rows in block_slices(header.count):
        sh0 = (colors[rows] / np.float32(255.0) - 0.5) / _COLOR_SCALE
        sh = np.concatenate([sh0, (harmonics[rows] - np.float32(128.0)) / 128.0], axis=1).reshape(len(sh0), -1, 3)
        yield Block(
            means=(_positions(positions[rows], header) * signs) @ turn.T,
            scales=np.exp(scales[rows] / np.float32(16.0) - 10.0),
            rotations=_product(quaternion, decode_rotations(rotations[rows]) * flips),
            opacities=opacities[rows, 0] / np.float32(255.0),
            sh=coefficients @ sh,
        )


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products (n, 4) of a quaternion (4,) and quaternions (n, 4), all wxyz."""
    w, x, y, z = a
    return b @ np.array([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]], np.float32)


def _positions(packed: np.ndarray, header: _Header) -> np.ndarray:
    """Decode positions (n, 3) of (n, 9) bytes, three fixed-point numbers of 24 bits; in version 1 of 6, half floats."""
    if header.version == 1:
        return packed.reshape(-1, 3, 2).view("<f2")[..., 0]
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
