"""Maps as PlayCanvas's compressed .ply: values packed into 32 bits within the bounds of each chunk of 256 Gaussians.

Layout: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import repeat

import numpy as np

from gsfeatloc_ros.maps.assemble import SH_C0, Block, single_precision_step
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, MapError
from gsfeatloc_ros.maps.ply_file import PlyFile, check_no_lists, columns

_CHUNK = 256
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_BOUNDS = [[f"{bound}_{axis}" for axis in "xyz"] for bound in ("min", "max", "min_scale", "max_scale")]
_COLOR_BOUNDS = [[f"{bound}_{channel}" for channel in "rgb"] for bound in ("min", "max")]


def check_layout(ply: PlyFile) -> int:
    """Refuse a header that is not that of a compressed map; return its SH coefficients per channel.

    Raises:
        MapError: an element or a property is missing, or of another type or number.
    """
    vertex = ply["vertex"]
    for name in _PACKED:
        if name not in vertex or np.dtype(vertex.dtype())[name] != np.uint32:
            raise MapError(f"{ply.path}: lacks the 32-bit {name} of a compressed map")
    if "chunk" not in ply:
        raise MapError(f"{ply.path}: has no element 'chunk', which bounds the values of a compressed map")
    chunk = ply["chunk"]
    check_no_lists(ply, chunk)
    if missing := [name for names in _BOUNDS for name in names if name not in chunk]:
        raise MapError(f"{ply.path}: lacks {', '.join(missing)} of a compressed map's chunks")
    if chunk.count != -(-vertex.count // _CHUNK):
        raise MapError(f"{ply.path}: is damaged: {chunk.count} chunks of {_CHUNK} for {vertex.count} Gaussians")
    if "sh" not in ply:
        return 1
    sh = ply["sh"]
    check_no_lists(ply, sh)
    coefficients = 1 + len(sh.properties) // 3
    expected = [f"f_rest_{index}" for index in range(3 * (coefficients - 1))]
    if coefficients not in SH_COEFFICIENTS or [p.name for p in sh.properties] != expected or sh.count != vertex.count:
        raise MapError(
            f"{ply.path}: is damaged: {sh.count} spherical harmonics of {len(sh.properties)} values for {vertex.count} "
            f"Gaussians; those of degree 1 to 3 have f_rest_0 up to a number of 9, 24 or 45"
        )
    return coefficients


def blocks(ply: PlyFile, coefficients: int) -> Iterator[Block]:
    """Yield runs of Gaussians, unpacked."""
    chunks = np.concatenate(list(ply.blocks("chunk")))
    (low, high), (low_scale, high_scale) = (
        [columns(chunks, names, dtype) for names in bounds]
        for bounds, dtype in ((_BOUNDS[:2], np.float64), (_BOUNDS[2:], np.float32))
    )
    double = all(chunks.dtype[name] == np.float64 for names in _BOUNDS[:2] for name in names)
    if all(name in ply["chunk"] for names in _COLOR_BOUNDS for name in names):
        low_color, high_color = (columns(chunks, names) for names in _COLOR_BOUNDS)
    else:
        low_color, high_color = np.zeros((len(chunks), 3), np.float32), np.ones((len(chunks), 3), np.float32)

    if not all(np.isfinite(bounds).all() for bounds in (low, high, low_scale, high_scale, low_color, high_color)):
        raise MapError(f"{ply.path}: is damaged: the bounds of its chunks are not all finite")

    start = 0
    harmonics = ply.blocks("sh") if coefficients > 1 else repeat(None)
    for rows, rest in zip(ply.blocks("vertex"), harmonics, strict=False):
        chunk = np.arange(start, start + len(rows)) // _CHUNK
        start += len(rows)

        def between(lows: np.ndarray, highs: np.ndarray, parts: np.ndarray, chunk: np.ndarray = chunk) -> np.ndarray:
            return lows[chunk] * (1.0 - parts) + highs[chunk] * parts

        colors = _unpack(rows["packed_color"], (8, 8, 8, 8))
        sh0 = (between(low_color, high_color, colors[:, :3]) - 0.5) / SH_C0
        means = between(low, high, _unpack(rows["packed_position"], (11, 10, 11)))
        yield Block(
            means=means,
            scales=np.exp(between(low_scale, high_scale, _unpack(rows["packed_scale"], (11, 10, 11)))),
            rotations=_unpack_rotations(rows["packed_rotation"]),
            opacities=colors[:, 3],
            sh=sh0[:, None] if rest is None else np.concatenate([sh0[:, None], _unpack_harmonics(rest)], axis=1),
            step=0.0 if double else single_precision_step(means.astype(np.float32)),
        )


def _unpack(packed: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Unpack fractions (n, len(bits)) float32 in [0, 1] of words (n,) that hold them from the highest bits down."""
    shifts = np.uint32(np.cumsum((*bits[1:], 0)[::-1])[::-1])
    masks = np.array([(1 << n) - 1 for n in bits], np.uint32)
    words = packed.astype(np.uint32)[:, None]
    return ((words >> shifts) & masks).astype(np.float32) / masks.astype(np.float32)


def _unpack_rotations(packed: np.ndarray) -> np.ndarray:
    """Unpack quaternions (n, 4) wxyz of words (n,): 2 bits tell the largest component, 10 hold each of the others."""
    three = (_unpack(packed, (2, 10, 10, 10))[:, 1:] - np.float32(0.5)) * np.float32(np.sqrt(2.0))
    largest = (packed.astype(np.uint32) >> np.uint32(30))[:, None]
    quaternions = np.empty((len(packed), 4), np.float32)
    np.put_along_axis(quaternions, np.arange(3) + (np.arange(3) >= largest), three, axis=1)
    rest = np.sqrt(np.maximum(1.0 - np.sum(three * three, axis=1, keepdims=True), 0.0))
    np.put_along_axis(quaternions, largest.astype(np.intp), rest, axis=1)
    return quaternions


def _unpack_harmonics(rows: np.ndarray) -> np.ndarray:
    """Unpack harmonics (n, C - 1, 3) of bytes: all of red, then of green, then of blue; 0 and 255 are -4 and 4."""
    values = columns(rows, list(rows.dtype.names or ()))
    fractions = np.where(values == 0, 0.0, np.where(values == 255, 1.0, (values + 0.5) / 256.0))
    return ((fractions - 0.5) * 8.0).astype(np.float32).reshape(len(rows), 3, -1).transpose(0, 2, 1)
