"""From what files hold to a map: block by block, so that no second copy of the map is ever in memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsfeatloc_ros.maps.gaussian_map import GaussianMap, MapError

# Constant harmonic of the sphere: colour = 0.5 + SH_C0 * its coefficient.
SH_C0 = 0.28209479177387814
# Gaussians taken apart at once: a block of them stays in the CPU's cache. A multiple of compressed .ply's chunk.
MAX_BLOCK_ROWS = 4096
# Of SH degree 3 these take 11.8 GB.
MAX_GAUSSIANS = 50_000_000
# An .spz of SH degree 3 takes no more for each.
MAX_PACKED_BYTES = 65 * MAX_GAUSSIANS
# Packed Gaussians compress to a half or a third. What claims to unpack to so many times its size is no map.
MAX_COMPRESSION_RATIO = 100


class Block(NamedTuple):
    """A run of a map's Gaussians, as in GaussianMap but unchecked: quaternions of any norm, any values."""

    means: np.ndarray  # (n, 3)
    scales: np.ndarray  # (n, 3)
    rotations: np.ndarray  # (n, 4) wxyz
    opacities: np.ndarray  # (n,)
    sh: np.ndarray  # (n, C, 3)


def check_count(path: Path, count: int) -> None:
    """Refuse a map of no Gaussians or of more than MAX_GAUSSIANS, before memory is taken for them."""
    if count == 0:
        raise MapError(f"{path}: holds no Gaussians")
    if count > MAX_GAUSSIANS:
        raise MapError(f"{path}: claims {count} Gaussians; at most {MAX_GAUSSIANS} are read: crop or thin the map")


def check_compression(path: Path, packed_size: int, file_size: int) -> None:
    """Refuse a claim of `packed_size` bytes compressed into a file of `file_size`, before memory is taken for them."""
    if packed_size > MAX_COMPRESSION_RATIO * file_size:
        raise MapError(f"{path}: is damaged: it claims {packed_size} bytes of Gaussians compressed to {file_size}")


def read_packed(path: Path, file: Path, limit: int = MAX_PACKED_BYTES) -> bytes:
    """Return the contents of one of the files of the map at `path`; refuse more than `limit` bytes."""
    size = file.stat().st_size
    if size > limit:
        raise MapError(f"{path}: {file.name} of {size} bytes is too large; at most {limit} are read")
    return file.read_bytes()


def block_slices(count: int) -> Iterator[slice]:
    """Yield slices of at most MAX_BLOCK_ROWS rows that cover `count` rows."""
    for start in range(0, count, MAX_BLOCK_ROWS):
        yield slice(start, min(start + MAX_BLOCK_ROWS, count))


def assemble(
    path: Path, count: int, sh_coefficients: int, blocks: Iterable[Block], antialiased: bool = False
) -> GaussianMap:
    """Gather `blocks`, which together hold `count` Gaussians, into a map.

    Raises:
        MapError: a value is not finite in float32, or a quaternion is of zero length.
    """
    gaussian_map = GaussianMap(
        means=np.empty((count, 3), np.float32),
        scales=np.empty((count, 3), np.float32),
        rotations=np.empty((count, 4), np.float32),
        opacities=np.empty(count, np.float32),
        sh=np.empty((count, sh_coefficients, 3), np.float32),
        antialiased=antialiased,
    )
    invalid, first_invalid, start = 0, 0, 0
    # What does not fit into float32 becomes infinite and is refused by its value.
    with np.errstate(over="ignore", invalid="ignore"):
        for block in blocks:
            rows = slice(start, start + len(block.means))
            finite = np.ones(len(block.means), dtype=bool)
            for name, values in block._asdict().items():
                stored = getattr(gaussian_map, name)[rows]
                stored[...] = values
                finite &= np.isfinite(stored).all(axis=tuple(range(1, stored.ndim)))
            # A Gaussian may be flatter than float32 can say, never of no extent.
            scales = gaussian_map.scales[rows]
            np.maximum(scales, np.finfo(np.float32).tiny, out=scales)
            rotations = gaussian_map.rotations[rows]
            norms = np.linalg.norm(rotations.astype(np.float64), axis=1)
            finite &= norms > 0
            rotations /= np.where(norms > 0, norms, 1.0)[:, None]
            if not finite.all():
                first_invalid = first_invalid if invalid else start + int(finite.argmin())
                invalid += int(np.count_nonzero(~finite))
            start = rows.stop
    if invalid:
        raise MapError(
            f"{path}: {invalid} of {count} Gaussians have values that are NaN, infinite or too large, or a rotation "
            f"quaternion of zero length, the first is number {first_invalid}"
        )
    return gaussian_map
