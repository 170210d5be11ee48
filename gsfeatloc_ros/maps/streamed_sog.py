"""Maps as streamed .sog: unbundled .sog for parts of the scene at several levels of detail, listed in a lod-meta.json.

Layout: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from gsfeatloc_ros.maps.assemble import Block, Gather, Layout, T, check_count
from gsfeatloc_ros.maps.gaussian_map import MapError
from gsfeatloc_ros.maps.options import ReadOptions
from gsfeatloc_ros.maps.sog import describe_unbundled_sog, open_unbundled_sog

_KEYS = ("version", "asset", "count", "counts", "lodLevels", "environment", "filenames", "tree")


@dataclass(frozen=True)
class _Unit:
    """An unbundled .sog of which rows, in ranges of first and last + 1, are of the level; None for all rows."""

    meta: Path
    ranges: list[tuple[int, int]] | None


def read_streamed_sog(path: Path, meta: dict[str, Any], options: ReadOptions, gather: Gather[T]) -> T:
    """Read one level of detail of a map from its lod-meta.json, already parsed, with the environment if there is one.

    Raises:
        MapError: a file is missing, damaged or of another version, or there is no such level.
        OSError: one cannot be read.
    """
    try:
        levels, units = _parse(path, meta, options.level)
    except MapError:
        raise
    except (AttributeError, KeyError, IndexError, TypeError, ValueError, RecursionError) as error:
        what = f"{type(error).__name__}: {error}"
        raise MapError(f"{path}: is damaged or no lod-meta.json of a streamed .sog ({what})") from error
    if not units:
        raise MapError(f"{path}: holds no Gaussians at level {options.level}")
    if missing := [unit.meta for unit in units if not unit.meta.is_file()]:
        raise MapError(f"{path}: is a streamed .sog that lacks a file: {missing[0]} is missing")
    layouts = [describe_unbundled_sog(unit.meta) for unit in units]
    counts = [sum(end - start for start, end in _ranges(*pair)) for pair in zip(units, layouts, strict=True)]
    check_count(path, sum(counts))
    notes = [f"level {options.level} of {levels} is read (map.level)"]
    notes += [f"lod-meta.json's {key!r} is not known and not used" for key in meta if key not in _KEYS]
    if len({layout.antialiased for layout in layouts}) > 1:
        raise MapError(f"{path}: some of its parts are trained antialiased and others not: write it again")
    coefficients = max(layout.sh_coefficients for layout in layouts)
    layout = Layout(sum(counts), coefficients, layouts[0].antialiased, tuple(notes))
    return gather(path, layout, _blocks(units, coefficients), options)


def _parse(path: Path, meta: dict[str, Any], level: int) -> tuple[int, list[_Unit]]:
    """Return the number of levels, and the files that hold Gaussians of one."""
    if meta.get("version", 1) != 1:
        raise MapError(f"{path}: is a streamed .sog of version {meta['version']}; version 1 is read")
    levels = int(meta["lodLevels"])
    if level >= levels:
        raise MapError(f"{path}: has levels 0 to {levels - 1}, no {level}: set map.level to one of them")
    files: dict[int, list[tuple[int, int]]] = {}
    nodes = [meta["tree"]]
    while nodes:
        node = nodes.pop()
        nodes += node.get("children", [])
        part = node.get("lods", {}).get(str(level))
        if part is not None:
            start, count = part["offset"], part["count"]
            if not (type(start) is type(count) is int and start >= 0 and count >= 0):
                raise ValueError(f"{part!r} is no range of rows")
            files.setdefault(part["file"], []).append((start, start + count))
    units = [_Unit(_inside(path, meta["filenames"][file]), sorted(ranges)) for file, ranges in sorted(files.items())]
    if meta.get("environment") is not None:
        units.append(_Unit(_inside(path, meta["environment"]), None))
    return levels, units


def _inside(path: Path, name: object) -> Path:
    """Return a file below the folder of the map; raise MapError for a name that leads out of it."""
    if not isinstance(name, str) or "\\" in name or "\0" in name:
        raise MapError(f"{path}: names the file {name!r}, which is no path")
    relative = PurePosixPath(name)
    if relative.is_absolute() or ".." in relative.parts or not relative.parts:
        raise MapError(f"{path}: names the file {name!r}, which is not in its folder")
    return path.parent / relative


def _ranges(unit: _Unit, layout: Layout) -> list[tuple[int, int]]:
    """Return the ranges of a unit's rows that are read; raise MapError where it has fewer."""
    ranges = [(0, layout.count)] if unit.ranges is None else unit.ranges
    starts, ends = [start for start, _ in ranges], [end for _, end in ranges]
    if ends[-1] > layout.count or any(a > b for a, b in zip(ends, starts[1:], strict=False)):
        raise MapError(
            f"{unit.meta}: has {layout.count} Gaussians, fewer than lod-meta.json takes from it, or some twice"
        )
    return ranges


def _blocks(units: list[_Unit], coefficients: int) -> Iterator[Block]:
    """Yield the Gaussians of the units one after the other; harmonics that a unit does not have are 0."""
    for unit in units:
        layout, blocks = open_unbundled_sog(unit.meta)
        wanted = np.zeros(layout.count, dtype=bool)
        for start, end in _ranges(unit, layout):
            wanted[start:end] = True
        first = 0
        for block in blocks:
            kept = wanted[first : first + len(block.means)]
            first += len(kept)
            missing = coefficients - block.sh.shape[1]
            yield Block(
                means=block.means[kept],
                scales=block.scales[kept],
                rotations=block.rotations[kept],
                opacities=block.opacities[kept],
                sh=np.pad(block.sh[kept], ((0, 0), (0, missing), (0, 0))),
            )
