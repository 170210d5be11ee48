"""Maps as .splat, the format of antimatter15's viewer: 32 bytes a Gaussian, no header, no spherical harmonics.

Layout: https://github.com/antimatter15/splat#converting-ply-files
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsfeatloc_ros.maps.assemble import SH_C0, Block, assemble, block_slices, check_count
from gsfeatloc_ros.maps.gaussian_map import GaussianMap, MapError

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])

_MAX_TEXT_BYTES = 1024


def read_splat(path: Path) -> GaussianMap:
    """Read a map from a .splat file.

    Raises:
        MapError: the file is not of whole, valid Gaussians; as it has no header, it may be of another format.
        OSError: it cannot be read.
    """
    size = path.stat().st_size
    count = size // _ROW.itemsize
    if size % _ROW.itemsize:
        raise MapError(
            f"{path}: is none of .ply, .spz, .sog and .splat, or truncated: {size} bytes are no whole number of a "
            f".splat's Gaussians of {_ROW.itemsize} bytes"
        )
    with path.open("rb") as stream:
        # Any bytes could be Gaussians, but without a zero, an opaque one and a negative number they are a text.
        start = stream.read(_MAX_TEXT_BYTES)
        if start.isascii() and b"\0" not in start:
            raise MapError(f"{path}: is none of .ply, .spz, .sog and .splat: it looks like a text")
    check_count(path, count)
    return assemble(path, count, 1, _blocks(path, count))


def _blocks(path: Path, count: int) -> Iterator[Block]:
    with path.open("rb") as stream:
        for rows in block_slices(count):
            block = np.fromfile(stream, _ROW, rows.stop - rows.start)
            if not (np.isfinite(block["mean"]).all() and (block["scale"] >= 0).all()):
                raise MapError(
                    f"{path}: is none of .ply, .spz, .sog and .splat, or damaged: read as a .splat it has positions "
                    f"that are not finite or negative scales among Gaussians {rows.start} to {rows.stop - 1}"
                )
            colors = block["rgba"].astype(np.float32) / 255.0
            yield Block(
                means=block["mean"],
                scales=block["scale"],
                # Writers cut q * 128 + 128 off to whole numbers: 127.5 is in the middle of those that give 127 and 128.
                rotations=block["rotation"].astype(np.float32) - 127.5,
                opacities=colors[:, 3],
                sh=((colors[:, :3] - 0.5) / SH_C0)[:, None],
            )
