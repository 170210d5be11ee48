"""Map files and the Gaussians in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from gsfeatloc_ros.maps.gaussian_map import GaussianMap, MapError
from gsfeatloc_ros.maps.nerfstudio import read_dataparser_transforms
from gsfeatloc_ros.maps.ply import read_ply
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.maps.sog import read_sog, read_unbundled_sog
from gsfeatloc_ros.maps.splat import read_splat
from gsfeatloc_ros.maps.spz import read_spz

__all__ = ["GaussianMap", "MapError", "Similarity", "load_map", "read_dataparser_transforms"]

# How the files of each format begin. A .splat begins with its first Gaussian, which may be any bytes, { for example.
_MAGICS = (
    (b"ply", read_ply),
    (b"NGSP", read_spz),
    (b"\x1f\x8b\x08", read_spz),
    (b"PK\x03\x04", read_sog),
    (b"PK\x05\x06", read_sog),  # an empty one
)
_MAX_HEAD_BYTES = 64


def load_map(path: str | Path, alignment: Similarity | None = None) -> GaussianMap:
    """Read a 3D Gaussian Splatting map; its format is told by what the file holds, not by its name.

    Args:
        path: a .ply in the layout of the INRIA trainer, gsplat and nerfstudio; a compressed .ply of PlayCanvas; a
            .splat; an .spz; a .sog, or the folder or meta.json of an unbundled one.
        alignment: the map's S_map_splat; without it the map's frame is the robot's.

    Raises:
        MapError: the file cannot be used; the message names it, what is wrong and what to do.
    """
    path = Path(path)
    try:
        gaussian_map = _reader(path)(path)
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise MapError(f"{path}: does not fit into this machine's memory: crop or thin the map") from error
    return gaussian_map if alignment is None else replace(gaussian_map, S_map_splat=alignment)


def _reader(path: Path) -> Callable[[Path], GaussianMap]:
    if path.is_dir():
        return read_unbundled_sog
    if path.exists() and not path.is_file():  # opening a pipe would wait for its writer
        raise MapError(f"{path}: is not a file")
    with path.open("rb") as stream:
        head = stream.read(_MAX_HEAD_BYTES)
    if not head:
        raise MapError(f"{path}: is an empty file")
    if head.startswith(b"{") and head.isascii() and b"\0" not in head:
        return read_unbundled_sog
    return next((reader for magic, reader in _MAGICS if head.startswith(magic)), read_splat)
