"""Maps as .splat, the format of antimatter15's viewer: 32 bytes a Gaussian, no header, no spherical harmonics.

Layout: https://github.com/antimatter15/splat#converting-ply-files
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsfeatloc_ros.maps.assemble import (
    SH_C0,
    Block,
    Gather,
    Layout,
    T,
    block_slices,
    check_count,
    single_precision_step,
)
from gsfeatloc_ros.maps.gaussian_map import MapError
from gsfeatloc_ros.maps.options import ReadOptions

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])

# As it has no header, a file is known by its values alone. Quaternions are of unit length but for the rounding to
# bytes: of 113,648 real ones all were to 1.1 %.
_MAX_NORM_ERROR = 0.05
_MAX_POSITION, _MAX_SCALE = 1e8, 1e6
_MAX_IMPLAUSIBLE_SHARE = 0.01


def read_splat(path: Path, options: ReadOptions, gather: Gather[T]) -> T:
    """Read a map from a .splat file.

    Raises:
        MapError: the file is not of whole, plausible Gaussians; as it has no header, it may be of another format.
        OSError: it cannot be read.
    """
    size = path.stat().st_size
    count = size // _ROW.itemsize
    if size % _ROW.itemsize:
        raise MapError(
            f"{path}: is of no format that is read, or truncated: {size} bytes are no whole number of a .splat's "
            f"Gaussians of {_ROW.itemsize} bytes"
        )
    check_count(path, count)
    _check_plausible(path, count)
    return gather(path, Layout(count, 1), _blocks(path, count), options)


def _rows(path: Path, count: int) -> Iterator[np.ndarray]:
    with path.open("rb") as stream:
        for rows in block_slices(count):
            yield np.fromfile(stream, _ROW, rows.stop - rows.start)


def _check_plausible(path: Path, count: int) -> None:
    """Refuse a file with more than a few rows that cannot be Gaussians, before memory is taken for all of them."""
    implausible = 0
    for block in _rows(path, count):
        with np.errstate(invalid="ignore"):
            plausible = (np.abs(block["mean"]) < _MAX_POSITION).all(axis=1)
            plausible &= ((block["scale"] >= 0) & (block["scale"] < _MAX_SCALE)).all(axis=1)
        norms = np.linalg.norm(_quaternions(block), axis=1)
        plausible &= np.abs(norms / 127.5 - 1.0) < _MAX_NORM_ERROR
        implausible += int(np.count_nonzero(~plausible))
        if implausible > _MAX_IMPLAUSIBLE_SHARE * count:
            raise MapError(
                f"{path}: is of no format that is read, or damaged: as a .splat, which has no header, more than "
                f"{_MAX_IMPLAUSIBLE_SHARE:.0%} of its rows have no finite position, no positive scale or no unit "
                f"quaternion"
            )


def _quaternions(block: np.ndarray) -> np.ndarray:
    """Return quaternions (n, 4) wxyz of length 127.5 of the rows of a file."""
    # Writers cut q * 128 + 128 off to whole numbers: 127.5 is in the middle of those that give 127 and 128.
    return block["rotation"].astype(np.float32) - 127.5


def _blocks(path: Path, count: int) -> Iterator[Block]:
    for block in _rows(path, count):
        colors = block["rgba"].astype(np.float32) / 255.0
        yield Block(
            means=block["mean"],
            scales=np.where(block["scale"] >= 0, block["scale"], np.nan),
            rotations=_quaternions(block),
            opacities=colors[:, 3],
            sh=((colors[:, :3] - 0.5) / SH_C0)[:, None],
            step=single_precision_step(block["mean"]),
        )
