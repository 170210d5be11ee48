"""Map files and the Gaussians in them."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsfeatloc_ros.maps.assemble import Block, Gather, Layout, T, parts, read_packed
from gsfeatloc_ros.maps.assemble import assemble as to_gaussian_map
from gsfeatloc_ros.maps.bundle import read_bundle
from gsfeatloc_ros.maps.files import find_map
from gsfeatloc_ros.maps.foreign import (
    HEAD_BYTES,
    refuse_foreign,
    refuse_foreign_folder,
    refuse_foreign_gzip,
    refuse_foreign_json,
    refuse_foreign_zip,
)
from gsfeatloc_ros.maps.gaussian_map import GaussianMap, MapError, Reading
from gsfeatloc_ros.maps.gsplat_png import is_gsplat_png, read_gsplat_png
from gsfeatloc_ros.maps.nerfstudio import read_dataparser_transforms
from gsfeatloc_ros.maps.options import ReadOptions
from gsfeatloc_ros.maps.ply import read_ply
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.maps.sog import ZIP_ERRORS, read_sog, read_unbundled_sog
from gsfeatloc_ros.maps.splat import read_splat
from gsfeatloc_ros.maps.spz import read_spz
from gsfeatloc_ros.maps.streamed_sog import read_streamed_sog

__all__ = [
    "GaussianMap",
    "MapError",
    "ReadOptions",
    "Reading",
    "Similarity",
    "load_map",
    "look_through",
    "read_dataparser_transforms",
]

_DEFAULT_OPTIONS = ReadOptions()
# The tree of a streamed .sog takes more than all else.
_MAX_JSON_BYTES = 1 << 26
# Of the most opaque Gaussian: what is fainter is drawn by no renderer (MIN_ALPHA in render/base.py).
_MIN_OPACITY = 1.0 / 255.0


def load_map(
    path: str | Path, alignment: Similarity | None = None, options: ReadOptions = _DEFAULT_OPTIONS
) -> GaussianMap:
    """Read a 3D Gaussian Splatting map; its format is told by what the file holds, not by its name.

    Args:
        path: a .ply in the layout of the INRIA trainer, gsplat and nerfstudio; a compressed .ply of PlayCanvas; a
            .splat; an .spz; a .sog, or the folder or meta.json of an unbundled one or of gsplat's PngCompression; the
            folder or lod-meta.json of a streamed .sog; the output folder of the INRIA trainer; a map bundle, of which
            the map alone is taken, after a look whether it is whole: MapSettings(path).resolved() has the rest.
        alignment: where the frame of the file lies in the robot's map frame; without it that is the robot's.
        options: what the file may leave open.

    Raises:
        MapError: the file cannot be used; the message names it, what is wrong and what to do.
    """
    path = _map_of(path)
    gaussian_map = gather_map(path, options, to_gaussian_map)
    check_seen(path, len(gaussian_map), gaussian_map.highest_opacity)
    return gaussian_map if alignment is None else gaussian_map.placed(alignment)


def look_through(
    path: str | Path,
    look: Callable[[GaussianMap], None],
    alignment: Similarity | None = None,
    options: ReadOptions = _DEFAULT_OPTIONS,
) -> None:
    """Read a map as `load_map` does, part by part, so that it is never whole in memory.

    Args:
        path, alignment, options: as for load_map.
        look: is given each part, which is gone when it returns.

    Raises:
        MapError: the file cannot be used; parts may have been looked at by then.
    """

    def gather(path: Path, layout: Layout, blocks: Iterable[Block], options: ReadOptions) -> None:
        count, most = 0, 0.0
        for part in parts(path, layout, blocks, options):
            count, most = count + len(part), max(most, part.highest_opacity)
            look(part if alignment is None else part.placed(alignment))
        check_seen(path, count, most)

    gather_map(_map_of(path), options, gather)


def _map_of(path: str | Path) -> Path:
    """Return the path of a map, that of the one in a bundle after a look whether it is whole."""
    bundle = read_bundle(path)
    if bundle is None:
        return Path(path)
    bundle.check_map()
    return bundle.map


def gather_map(path: Path, options: ReadOptions, gather: Gather[T]) -> T:
    """Read a map that is no bundle, and return what `gather` makes of its blocks.

    Raises:
        MapError: the file cannot be used.
    """
    try:
        found = find_map(path)
        said = f"of the folder, {found.relative_to(path)} is read" if path.is_dir() else ""

        def gather_noted(path: Path, layout: Layout, blocks: Iterable[Block], options: ReadOptions) -> T:
            notes = (said, *layout.notes) if said else layout.notes
            return gather(path, replace(layout, notes=notes), blocks, options)

        # What does not fit into float32 becomes infinite and is left out by its value.
        with np.errstate(over="ignore", invalid="ignore"):
            return _read(found, options, gather_noted)
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise MapError(f"{path}: does not fit into this machine's memory: crop or thin the map") from error


def check_seen(path: Path, count: int, most: float) -> None:
    """Raise MapError where none of the `count` Gaussians of a map can be seen, by the highest opacity of them."""
    if most < _MIN_OPACITY:
        raise MapError(
            f"{path}: nothing in it can be seen: none of its {count} Gaussians has an opacity of more than "
            f"{most:.2g}; was its training, or its export, broken off?"
        )


def _read(path: Path, options: ReadOptions, gather: Gather[T]) -> T:
    if path.is_dir():
        refuse_foreign_folder(path)
    if path.exists() and not path.is_file():  # opening a pipe would wait for its writer
        raise MapError(f"{path}: is not a file")
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    if not head:
        raise MapError(f"{path}: is an empty file")
    # A .splat begins with its first Gaussian, which may be any bytes, { for example.
    if head.startswith(b"ply"):
        return read_ply(path, options, gather)
    if head.startswith(b"NGSP"):
        return read_spz(path, options, gather)
    if head.startswith(b"\x1f\x8b\x08"):
        return _read_gzip(path, head, options, gather)
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):  # the latter is an empty zip
        return _read_zip(path, options, gather)
    if head.startswith(b"{") and head.isascii() and b"\0" not in head:
        return _read_json(path, options, gather)
    refuse_foreign(path, head)
    return read_splat(path, options, gather)


def _read_gzip(path: Path, head: bytes, options: ReadOptions, gather: Gather[T]) -> T:
    try:
        beginning = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(head, 16)
    except zlib.error as error:
        raise MapError(f"{path}: is a damaged gzip: {error}") from error
    if beginning and not b"NGSP".startswith(beginning[:4]):
        refuse_foreign_gzip(path, beginning)
    return read_spz(path, options, gather)


def _read_zip(path: Path, options: ReadOptions, gather: Gather[T]) -> T:
    try:
        refuse_foreign_zip(path)
    except ZIP_ERRORS as error:
        raise MapError(f"{path}: is a truncated or damaged zip: {error}") from error
    return read_sog(path, options, gather)


def _read_json(path: Path, options: ReadOptions, gather: Gather[T]) -> T:
    try:
        meta = json.loads(read_packed(path, path, _MAX_JSON_BYTES))
    except (ValueError, RecursionError) as error:
        raise MapError(f"{path}: is a damaged JSON file: {error}") from error
    if isinstance(meta, dict) and {"lodLevels", "tree"} <= set(meta):
        return read_streamed_sog(path, meta, options, gather)
    if is_gsplat_png(meta):
        return read_gsplat_png(path, meta, options, gather)
    refuse_foreign_json(path, meta)
    return read_unbundled_sog(path, options, gather)
