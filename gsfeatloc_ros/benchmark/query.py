"""Time of localizations, by stage."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.benchmark.measure import Timed, spread, stage_time, timed
from gsfeatloc_ros.evaluate.protocol import make_priors, paper_prior_error
from gsfeatloc_ros.evaluate.scene import load_scene, load_scene_renderer
from gsfeatloc_ros.localize.engine import load_matcher
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.settings import MatcherSettings, RendererSettings


def measure_queries(scene_path: Path, matcher_name: str, sigma: float, device: str, threads: int) -> dict[str, Any]:
    """Localize the test photos of a scene once each, from priors as wrong as in the paper times `sigma`.

    Returns:
        Milliseconds by stage (median over the photos; CPU time, on a GPU wall time), CPU and wall milliseconds of the
        whole (min and median), and how many were localized.

    Raises:
        ValueError, OSError, RuntimeError: the scene, the matcher or the device cannot be used.
    """
    scene = load_scene(scene_path)
    renderer = load_scene_renderer(scene, RendererSettings(device=device, threads=threads))
    matcher = load_matcher(MatcherSettings(name=matcher_name), renderer.device)
    clock, now = stage_time(renderer.device)
    localizer = Localizer(renderer, matcher, now=now)
    error = paper_prior_error(scene, sigma)
    queries = [
        (scene.read_photo(photo), photo.camera, prior, error.covariance)
        for photo, prior in zip(scene.photos, make_priors(scene, error, seed=0), strict=True)
    ]
    localizer.localize(*queries[0])  # what is compiled or loaded at the first call does not count
    done = [timed(localizer.localize, *query) for query in queries]
    return {"scene": scene.name, "matcher": matcher_name, "sigma": sigma, **times_of(done, clock)}


def times_of(done: Sequence[Timed[Estimate]], clock: str) -> dict[str, Any]:
    """Return the times of localizations as measure_queries does; `clock` is that of the stages, "cpu" or "wall"."""
    stages = {name for query in done for name in query.result.milliseconds} - {"total"}
    by_stage = {name: float(np.median([query.result.milliseconds.get(name, 0.0) for query in done])) for name in stages}
    return {
        "photos": len(done),
        "localized": sum(query.result.localized for query in done),
        "passes": float(np.mean([query.result.evidence.passes for query in done])),
        "views": float(np.mean([query.result.evidence.views for query in done])),
        "cpu_ms": spread([query.cpu for query in done]),
        "wall_ms": spread([query.wall for query in done]),
        f"stages_{clock}_ms": dict(sorted(by_stage.items(), key=lambda item: -item[1])),
    }


def print_queries(report: dict[str, Any]) -> None:
    """Print what measure_queries found."""
    print_times(f"{report['scene']}, {report['matcher']}", report)


def print_times(title: str, report: dict[str, Any]) -> None:
    """Print what times_of found."""
    print(
        f"{title}: {report['localized']} of {report['photos']} photos localized, "
        f"{report['passes']:.1f} passes and {report['views']:.1f} other views each"
    )
    for name in ("cpu", "wall"):
        times = report[f"{name}_ms"]
        print(f"  {name:8} ms a query: min {times['min']:7.1f}  median {times['median']:7.1f}")
    for clock in ("cpu", "wall"):
        for name, milliseconds in report.get(f"stages_{clock}_ms", {}).items():
            print(f"  {name:8} {clock} ms: median {milliseconds:7.1f}")
