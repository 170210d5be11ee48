"""Prepared maps kept in files beside the maps: reading one takes a fraction of the time of preparing it again."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsfeatloc_ros.common.kernel_cache import hash_of_sources
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.common.safe_files import open_own
from gsfeatloc_ros.maps import GaussianMap, MapError, ReadOptions, Similarity, check_seen, gather_map
from gsfeatloc_ros.maps.assemble import Block, Layout, assemble
from gsfeatloc_ros.maps.bundle import read_bundle
from gsfeatloc_ros.maps.files import content_of, map_files
from gsfeatloc_ros.render.cache_file import CacheError, read, write
from gsfeatloc_ros.render.chunks import LARGE_MAP, PreparedMap
from gsfeatloc_ros.render.prepare import prepare
from gsfeatloc_ros.render.prepare_large import Survey, prepare_in_file, survey

SUFFIX = ".gsfeatloc-cache"

_log = logging.getLogger(__name__)

_DEFAULT_OPTIONS = ReadOptions()


def load_prepared(
    path: str | Path,
    alignment: Similarity | None = None,
    options: ReadOptions = _DEFAULT_OPTIONS,
    cache_path: str | Path | None = None,
) -> PreparedMap:
    """Read a map prepared from its cache; where there is none for it, load and prepare it, and write the cache.

    Args:
        path, options: as for load_map.
        alignment: as for load_map; it is no part of the cache.
        cache_path: file of the cache; None for the map's name and SUFFIX, in the same folder; of a bundle, in it. That
            it cannot be written is no error.

    Raises:
        MapError: the map cannot be used.
    """
    bundle = read_bundle(path)
    path = Path(path) if bundle is None else bundle.map
    absolute = Path(os.path.abspath(path))
    cache_path = absolute.with_name(absolute.name + SUFFIX) if cache_path is None else Path(cache_path)
    content = [content_of(file) for file in map_files(absolute)]
    if bundle is not None:
        bundle.check_map(content)
    origin = {"code": _code(), "map": content, "options": asdict(options)}
    prepared = _read_if_usable(cache_path, origin)
    if prepared is None:
        prepared = _prepared(path, options, cache_path, origin)
    return prepared if alignment is None else prepared.placed(alignment)


def _prepared(path: Path, options: ReadOptions, cache_path: Path, origin: dict[str, Any]) -> PreparedMap:
    """Prepare a map, a large one in its cache, and write the cache."""

    def gather(path: Path, layout: Layout, blocks: Iterable[Block], options: ReadOptions) -> GaussianMap | Survey:
        return (survey if layout.count > LARGE_MAP else assemble)(path, layout, blocks, options)

    found = gather_map(path, options, gather)
    if isinstance(found, Survey):
        try:
            with replaced_file(cache_path) as stream:
                prepare_in_file(found, stream, origin, cache_path.parent)
        except OSError as error:
            _log.warning(
                "%s: cannot be written (%s): the map is prepared in memory", cache_path, error.strerror or error
            )
        else:
            prepared = _read_if_usable(cache_path, origin)
            if prepared is not None:
                return prepared
        found = gather_map(path, options, assemble)
    check_seen(path, len(found), found.highest_opacity)
    prepared = prepare(found)
    _write_if_possible(cache_path, prepared, origin)
    return prepared


def _read_if_usable(path: Path, origin: dict[str, Any]) -> PreparedMap | None:
    """Return the map in a cache; None where there is no cache of a map of this `origin`."""
    try:
        with open_own(path) as stream:
            return read(stream, origin)
    except FileNotFoundError:
        return None
    except (OSError, CacheError) as error:
        _log.warning("%s: %s: ignored, the map is prepared again", path, error)
        return None


def _write_if_possible(path: Path, prepared: PreparedMap, origin: dict[str, Any]) -> None:
    """Write a cache; that it cannot be written is no error."""
    try:
        with replaced_file(path) as stream:
            write(stream, prepared, origin)
    except OSError as error:
        _log.debug("%s: cannot be written: %s", path, error.strerror or error)


def map_content(path: str | Path) -> list[Any]:
    """Return what tells the content of a map from that of others: size and SHA-256 of each of its files.

    It is the same for a copy under another name. Of a map in a bundle it is what the manifest says: those that load
    the map check it.

    Raises:
        MapError: the map cannot be read.
    """
    bundle = read_bundle(path)
    if bundle is not None:
        return bundle.map_content
    files = map_files(Path(os.path.abspath(path)))
    if not files:
        raise MapError(f"{path}: cannot be read: there is no such map")
    return [content_of(file) for file in files]


@functools.cache
def _code() -> str:
    """Return the version of the code that reads and prepares maps; all that may have a part in that counts."""
    return hash_of_sources("maps", "render")
