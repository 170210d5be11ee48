"""Growth of an index with its views: seconds to make it, size, and time of a query, as a plot.

Rendering and finding features takes as long for each view as for any other; it is measured on the simulated room. What
comes after that is measured on made-up features, as many as a view has.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.benchmark.measure import machine
from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.index import IndexOptions, ViewIndex, build_index
from gsfeatloc_ros.index.landmarks import Landmarks
from gsfeatloc_ros.index.storage import save_index
from gsfeatloc_ros.match import Features, create_matcher
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.simulate import Room, cover

COUNTS = (100, 300, 1000, 3000, 10_000, 50_000)
# Of the room's map, which need to be rendered.
_RENDERED_COUNTS = (30, 100)
# Of each made-up view, of a photo, and how many numbers each has.
_VIEW_FEATURES, _PHOTO_FEATURES, _DIMENSION = 60, 500, 128
_QUERIES = 5
_ROOM, _MADE_UP = "made, the room", "made of features that are there"


def measure_index(counts: Sequence[int] = COUNTS) -> list[dict[str, Any]]:
    """Measure indices of so many views.

    Returns:
        A row for each: "views", "features", "source", "make_s" CPU-seconds; of made-up features also "size_mb",
        "load_s", CPU-seconds until the first query can be answered, and "query_ms", CPU-milliseconds of ranking all
        views for a photo.
    """
    rows = []
    renderer, matcher = create_renderer(cover(Room())), create_matcher("sift")
    # What is compiled at the first call does not count.
    build_index(renderer, matcher, IndexOptions(views=_RENDERED_COUNTS[0]))
    for views in _RENDERED_COUNTS:
        start = time.process_time()
        index = build_index(renderer, matcher, IndexOptions(views=views))
        rows.append(_row(_ROOM, index, time.process_time() - start))
    for views in counts:
        rng = np.random.default_rng(0)
        poses = np.broadcast_to(np.eye(4), (views, 4, 4))
        count = views * _VIEW_FEATURES
        seen = np.split(np.arange(count), views)
        landmarks = Landmarks(_descriptors(rng, count), rng.random((count, 3)), seen)
        start = time.process_time()
        index = ViewIndex.compress(poses, landmarks)
        made = time.process_time() - start
        del landmarks
        rows.append(_row(_MADE_UP, index, made) | _query(index, rng))
    return rows


def draw_index(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw what measure_index found to an image file; raise RuntimeError where matplotlib is not installed."""
    pyplot = import_extra("matplotlib.pyplot")
    figure, axes = pyplot.subplots(1, 3, figsize=(12, 4), layout="constrained")
    room, made_up = ([row for row in rows if row["source"] == source] for source in (_ROOM, _MADE_UP))

    def draw(number: int, own: Sequence[dict[str, Any]], figure_of: str, label: str) -> None:
        axes[number].plot([row["views"] for row in own], [row[figure_of] for row in own], "o-", label=label)

    draw(0, room, "make_s", "made of the room's map")
    draw(0, made_up, "make_s", "compression")
    draw(0, made_up, "load_s", "first query")
    draw(1, made_up, "size_mb", "file")
    draw(2, made_up, "query_ms", "all views ranked")
    for axis, label in zip(axes, ("CPU-seconds", "MB", "CPU-ms"), strict=True):
        axis.set(xlabel="views", ylabel=label, xscale="log", yscale="log")
        axis.grid(which="both", alpha=0.3)
        axis.legend(loc="lower right", fontsize="x-small")
    words = f"made-up features, {_VIEW_FEATURES} a view; a photo of {_PHOTO_FEATURES}"
    figure.suptitle(f"{words}\n{machine()['cpu']}, {machine()['cores']} cores")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _row(source: str, index: ViewIndex, seconds: float) -> dict[str, Any]:
    row = {"source": source, "views": len(index), "features": len(index.codes), "make_s": seconds}
    print(f"{source}: {len(index)} views, {len(index.codes)} features, {seconds:.2f} CPU-s", flush=True)
    return row


def _query(index: ViewIndex, rng: np.random.Generator) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "index"
        save_index(path, index, {})
        size = path.stat().st_size / 1e6
    photo = Features(
        np.zeros((_PHOTO_FEATURES, 2), np.float32),
        _descriptors(rng, _PHOTO_FEATURES),
        np.ones(_PHOTO_FEATURES, np.float32),
    )
    times = []
    for _ in range(1 + _QUERIES):
        start = time.process_time()
        index.rank(index.nearest(photo))
        times.append(time.process_time() - start)
    return {"size_mb": size, "load_s": times[0], "query_ms": 1000 * min(times[1:])}


def _descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.standard_normal((count, _DIMENSION), np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
