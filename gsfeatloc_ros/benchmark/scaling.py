"""Growth of the time of a frame with Gaussians, pixels and threads, as a plot."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from gsfeatloc_ros.benchmark.frames import Size, measure_frames, pinhole
from gsfeatloc_ros.benchmark.measure import machine
from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.render.prepare import prepare
from gsfeatloc_ros.simulate.two_rooms import VIEWS, two_rooms

COUNTS = (100_000, 200_000, 500_000, 1_000_000, 2_000_000, 5_000_000)
_SIZES = ((160, 120), (320, 240), (640, 480), (960, 720), (1280, 960))
# Kept while another is varied.
_KEPT_SIZE, _KEPT_COUNT = (640, 480), 500_000
_FRAMES = 10
_LABELS = {"gaussians": "Gaussians", "pixels": "pixels", "threads": "threads"}
_COLORS = {"everything": "tab:blue", "typical": "tab:orange"}


def measure_scaling(counts: Sequence[int] = COUNTS) -> list[dict[str, Any]]:
    """Time frames of the two rooms on the CPU, with Gaussians (`counts`), pixels and threads varied one at a time.

    Returns:
        A row for each value of each of the three, and each view: "varied", "value", "view", "cpu_ms" and "wall_ms".
    """
    cores = len(os.sched_getaffinity(0))
    base = min(_KEPT_COUNT, max(counts))
    rows = list(_rows("threads", base, [(_KEPT_SIZE, threads, threads) for threads in range(1, cores + 1)]))
    rows += _rows("pixels", base, [(size, cores, size[0] * size[1]) for size in _SIZES])
    for count in counts:
        rows += _rows("gaussians", count, [(_KEPT_SIZE, cores, count)])
    return rows


def _rows(varied: str, count: int, settings: Iterable[tuple[Size, int, int]]) -> list[dict[str, Any]]:
    """Measure `count` Gaussians at each setting: size, threads, and the value that is varied; return a row for each."""
    prepared = prepare(two_rooms(count))
    rows = []
    for size, threads, value in settings:
        renderer = create_renderer(prepared, "cpu", threads)
        for view, pose in VIEWS.items():
            report = measure_frames(renderer, pinhole(size), [pose] * _FRAMES)
            rows.append({"varied": varied, "value": value, "view": view} | report)
            print(f"{varied} {value}, {view}: {report['cpu_ms']['min']:.1f} CPU-ms", flush=True)
    return rows


def draw_scaling(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw what measure_scaling found to an image file.

    Raises:
        RuntimeError: matplotlib is not installed.
    """
    pyplot = import_extra("matplotlib.pyplot")
    figure, axes = pyplot.subplots(1, len(_LABELS), figsize=(12, 4), sharey=True, layout="constrained")
    for axis, (varied, label) in zip(axes, _LABELS.items(), strict=True):
        for view, color in _COLORS.items():
            own = [row for row in rows if row["varied"] == varied and row["view"] == view]
            for time, style in (("cpu_ms", "o-"), ("wall_ms", "s--")):
                words = f"{view}, {'CPU' if time == 'cpu_ms' else 'wall'}"
                axis.plot([r["value"] for r in own], [r[time]["min"] for r in own], style, color=color, label=words)
        axis.set(xlabel=label, xscale="log", yscale="log")
        axis.grid(which="both", alpha=0.3)
    axes[-1].set_xscale("linear")
    axes[-1].xaxis.get_major_locator().set_params(integer=True)
    axes[0].set_ylabel("ms per frame, the least of several")
    axes[0].legend()
    kept = (
        f"two rooms; {_KEPT_COUNT:,} Gaussians, {_KEPT_SIZE[0]}x{_KEPT_SIZE[1]}, all threads where not said otherwise"
    )
    figure.suptitle(f"{kept}\n{machine()['cpu']}, {machine()['cores']} cores")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
