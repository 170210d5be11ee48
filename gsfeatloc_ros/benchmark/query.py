"""One localization after another, by stage."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.benchmark.measure import spread, stage_time, timed
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.evaluate.protocol import make_priors, paper_prior_error
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.localize import localizer as localize
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.render import DrawOptions, create_renderer


def measure_queries(scene_path: Path, matcher_name: str, sigma: float, device: str, threads: int) -> dict[str, Any]:
    """Localize the test photos of a scene once each, from priors as wrong as in the paper times `sigma`.

    Returns:
        Milliseconds by stage (median over the photos; CPU time, on a GPU wall time), CPU and wall milliseconds of the
        whole (min and median), and how many were localized.

    Raises:
        ValueError, OSError, RuntimeError: the scene, the matcher or the device cannot be used.
    """
    scene = load_scene(scene_path)
    renderer = create_renderer(load_map(scene.map_path), device, threads, DrawOptions(scene.background))
    localizer = Localizer(renderer, create_matcher(matcher_name, device=device))
    error = paper_prior_error(scene, sigma)
    queries = [
        (scene.read_photo(photo), photo.camera, prior, error.covariance)
        for photo, prior in zip(scene.photos, make_priors(scene, error, seed=0), strict=True)
    ]
    localizer.localize(*queries[0])  # what is compiled or loaded at the first call does not count
    clock, now = stage_time(renderer.device)
    with _stages_by(now):
        done = [timed(localizer.localize, *query) for query in queries]
    stages = {name for query in done for name in query.result.milliseconds} - {"total"}
    by_stage = {name: float(np.median([query.result.milliseconds.get(name, 0.0) for query in done])) for name in stages}
    return {
        "scene": scene.name,
        "matcher": matcher_name,
        "sigma": sigma,
        "photos": len(done),
        "localized": sum(query.result.localized for query in done),
        "passes": float(np.mean([query.result.passes for query in done])),
        "views": float(np.mean([query.result.views for query in done])),
        "cpu_ms": spread([query.cpu for query in done]),
        "wall_ms": spread([query.wall for query in done]),
        f"stages_{clock}_ms": dict(sorted(by_stage.items(), key=lambda item: -item[1])),
    }


def print_queries(report: dict[str, Any]) -> None:
    """Print what measure_queries found."""
    print(
        f"{report['scene']}, {report['matcher']}: {report['localized']} of {report['photos']} photos localized, "
        f"{report['passes']:.1f} passes and {report['views']:.1f} other views each"
    )
    for name in ("cpu", "wall"):
        times = report[f"{name}_ms"]
        print(f"  {name:8} ms a query: min {times['min']:7.1f}  median {times['median']:7.1f}")
    for clock in ("cpu", "wall"):
        for name, milliseconds in report.get(f"stages_{clock}_ms", {}).items():
            print(f"  {name:8} {clock} ms: median {milliseconds:7.1f}")


@contextmanager
def _stages_by(now: Callable[[], float]) -> Iterator[None]:
    """While this is open, localizers count the time of their stages by another clock."""
    before = localize.StageClock
    localize.StageClock = partial(StageClock, now)
    try:
        yield
    finally:
        localize.StageClock = before
