"""The index of the views of an engine's map: read from its file, or made and written there."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.index import IndexOptions, ViewIndex, build_index
from gsfeatloc_ros.index.storage import index_path, load_index, save_index
from gsfeatloc_ros.localize.engine import Engine
from gsfeatloc_ros.localize.settings import MapSettings, MatcherSettings
from gsfeatloc_ros.render.cache import map_content

_log = logging.getLogger(__name__)


def index_for(
    engine: Engine,
    options: IndexOptions,
    key: dict[str, Any],
    progress: Callable[[int, int], None] = lambda done, total: None,
    interrupted: Callable[[], bool] = lambda: False,
) -> ViewIndex | None:
    """Read the index of an engine's map; where there is none of this map, make it and write it.

    How many views it has, and whether it was made with training poses, does not matter: what is there is used. Nor does
    where the views are placed, unless the options say where.

    Args:
        engine: of the map.
        options: where the index is, and how it is made.
        key: what it has to be of, as of `index_key`.
        progress, interrupted: as for build_index.

    Returns:
        The index; None where there is none and none is to be made.

    Raises:
        Interrupted: `interrupted` said so.
        ValueError, OSError: there is none and none can be made; the message says why.
    """
    path = Path(options.path) if options.path else index_path(engine.map_path)
    if not options.build:
        return _usable(path, key)
    return load_or_make(path, key, lambda: build_index(engine.renderer, engine.matcher, options, progress, interrupted))


def load_or_make(path: Path, key: dict[str, Any], make: Callable[[], ViewIndex]) -> ViewIndex:
    """Read an index that was made of `key`; where there is none, make it and write it, and say where that fails."""
    found = _usable(path, key)
    if found is not None:
        return found
    made = make()
    try:
        save_index(path, made, key)
    except OSError as error:
        _log.warning("%s: cannot be written, the index is made again next time: %s", path, error.strerror or error)
    return made


def _usable(path: Path, key: dict[str, Any]) -> ViewIndex | None:
    """Read an index that was made of `key`, ready to be searched; None where there is none that can be used."""
    try:
        found = load_index(path, key)
    except (ValueError, OSError) as error:
        _log.warning("%s: the index of views is made again", error)
        return None
    if found is not None:
        # Here, not at the first image.
        found.prepare()
    return found


def index_key(map_path: str, map_: MapSettings, matcher: MatcherSettings, options: IndexOptions) -> dict[str, Any]:
    """Return what an index is of: the map, how it is read, where it lies, the features, and the plane if there is one.

    It is ready for JSON.
    """
    placed = map_.alignment()
    plane = {"plane": [options.camera_height, options.camera_pitch]} if options.on_plane else {}
    return plane | {
        "map": map_content(map_path),
        "reading": asdict(map_.reading),
        "alignment": np.hstack([placed.scale * placed.rotation, placed.translation[:, None]]).round(9).tolist(),
        "matcher": [matcher.name, matcher.weights],
    }
