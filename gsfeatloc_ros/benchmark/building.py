"""Large maps: memory, starts, frames and queries in buildings of more and more rooms."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.benchmark.frames import UNCOUNTED_FRAMES, pinhole
from gsfeatloc_ros.benchmark.measure import spread, status_megabytes, timed
from gsfeatloc_ros.common.geometry import make_pose, rotation_error_deg, so3_exp, translation_error
from gsfeatloc_ros.localize.engine import load_matcher, load_renderer
from gsfeatloc_ros.localize.first_run import warm_up
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.settings import MapSettings, MatcherSettings, RendererSettings
from gsfeatloc_ros.maps.ply import write_ply_parts
from gsfeatloc_ros.render import Renderer, create_renderer
from gsfeatloc_ros.render.cache import SUFFIX
from gsfeatloc_ros.render.prepare import prepare
from gsfeatloc_ros.simulate.building import ROOM_GAUSSIANS, ROOMS_OF_A_STOREY, Building

_CAMERA = pinhole((640, 480))
# Frames and queries are of so many rooms all over the building, and so many poses in each.
_ROOMS, _POSES_OF_A_ROOM = 3, 4
_POSES = _ROOMS * _POSES_OF_A_ROOM
# How wrong priors are, one standard deviation: radians and metres.
_PRIOR_ERRORS = (0.05, 0.1)
_RENDERER = RendererSettings(device="cpu")


def measure_buildings(
    rooms: Sequence[int], folder: Path, sh_degree: int = 0, room_gaussians: int = ROOM_GAUSSIANS
) -> list[dict[str, Any]]:
    """Measure buildings of so many rooms, each of so many Gaussians.

    Args:
        rooms: of each building.
        folder: of the maps, which are made unless they are there.
        sh_degree: of the spherical harmonics.
        room_gaussians: of each room.

    Returns:
        A row for each, with "gaussians"; "first" and "second", how the map is loaded without and with its cache:
        seconds, CPU-seconds and megabytes; "serving", megabytes while frames are drawn and photos are localized; the
        CPU-milliseconds of "frames", of one along the "corridor", and of "queries"; how many are "localized", and their
        "errors", degrees and metres.
    """
    rows = []
    for count in rooms:
        gaussians = count * room_gaussians
        path = folder / f"building_{count}_{sh_degree}.ply"
        if not path.exists():
            write_ply_parts(path, Building(count).parts(room_gaussians, sh_degree), gaussians)
        row = {"rooms": count, "gaussians": gaussians, "sh_degree": sh_degree}
        row |= _in_a_process(_first_start, path)
        photos = _in_a_process(_photos, Building(count), room_gaussians, sh_degree)
        row |= _in_a_process(_serve, path, Building(count), photos)
        rows.append(row)
        print_building(row)
    return rows


def print_building(row: dict[str, Any]) -> None:
    """Print a row of measure_buildings."""
    print(f"{row['rooms']} rooms, {row['gaussians']} Gaussians of SH degree {row['sh_degree']}")
    for name in ("first", "second"):
        start = row[name]
        print(
            f"  {name} start: {start['seconds']:.1f} s, {start['cpu_seconds']:.1f} CPU-s, at most "
            f"{start['anonymous_mb']:.0f} MB, and {start['file_mb']:.0f} MB of files"
        )
    serving = row["serving"]
    print(f"  then at most {serving['anonymous_mb']:.0f} MB, and {serving['file_mb']:.0f} MB of files")
    for name in ("frames", "corridor", "queries"):
        print(f"  {name}: CPU-ms min {row[name]['min']:.1f}  median {row[name]['median']:.1f}")
    print(
        f"  {row['localized']} of {_POSES} localized, {row['errors'][0]:.3f} degrees and {1e3 * row['errors'][1]:.1f} "
        "mm off in the median",
        flush=True,
    )


def _in_a_process(part: Callable[..., Any], *arguments: object) -> Any:
    """Return what a function returns in a process of its own, so that memory is that of nothing else."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        return process.submit(part, *arguments).result()


def _first_start(path: Path) -> dict[str, Any]:
    path.with_name(path.name + SUFFIX).unlink(missing_ok=True)
    return {"first": _start(path)[1]}


def _photos(building: Building, room_gaussians: int, sh_degree: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return poses, (4, 4) each, and what is seen there of the storey, exactly: doors show more than the one room."""
    photos, storey = [], -1
    for room in (number * building.rooms // _ROOMS for number in range(_ROOMS)):
        if storey != room // ROOMS_OF_A_STOREY:
            storey = room // ROOMS_OF_A_STOREY
            seen = building.storey(storey, room_gaussians, sh_degree)
            renderer = create_renderer(prepare(seen, large=len(seen)), "cpu")
        poses = [building.pose(room, seed) for seed in range(_POSES_OF_A_ROOM)]
        photos += [(pose, renderer.render(_CAMERA, pose).image()) for pose in poses]
    return photos


def _start(path: Path) -> tuple[Renderer, dict[str, float]]:
    warm_up(device="cpu")
    with _watched() as memory:
        loaded = timed(load_renderer, MapSettings(path=str(path)), _RENDERER)
    return loaded.result, {"seconds": 1e-3 * loaded.wall, "cpu_seconds": 1e-3 * loaded.cpu} | vars(memory)


def _serve(path: Path, building: Building, photos: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    renderer, second = _start(path)
    localizer = Localizer(renderer, load_matcher(MatcherSettings(), "cpu"))
    rng = np.random.default_rng(0)
    with _watched() as memory:
        corridor = _frames(renderer, [building.corridor_pose()] * 5)
        frames = _frames(renderer, [pose for pose, _ in photos])
        queries = []
        for pose, photo in photos:
            error = rng.normal(size=(2, 3)) * np.reshape(_PRIOR_ERRORS, (2, 1))
            prior = make_pose(so3_exp(error[0]) @ pose[:3, :3], pose[:3, 3] + error[1])
            covariance = np.diag(np.repeat(np.square(_PRIOR_ERRORS[::-1]), 3))
            queries.append((pose, timed(localizer.localize, photo, _CAMERA, prior, covariance)))
    found = [(pose, there) for pose, query in queries if (there := query.result.T_map_camera) is not None]
    errors = [(rotation_error_deg(there, pose), translation_error(there, pose)) for pose, there in found]
    return {
        "second": second,
        "serving": vars(memory),
        "frames": frames,
        "corridor": corridor,
        "queries": spread([query.cpu for _, query in queries[1:]]),
        "localized": len(found),
        "errors": np.median(errors, axis=0).tolist() if errors else [np.nan, np.nan],
    }


def _frames(renderer: Renderer, poses: list[np.ndarray]) -> dict[str, float]:
    """Return the CPU-milliseconds of frames at poses, (4, 4) each, of which the first grow buffers."""
    for pose in poses[:UNCOUNTED_FRAMES]:
        renderer.render(_CAMERA, pose)
    return spread([timed(renderer.render, _CAMERA, pose).cpu for pose in poses])


@dataclass
class _Memory:
    """Megabytes of the process at most: its own, and of files that are mapped, which the system may take back."""

    anonymous_mb: float = 0.0
    file_mb: float = 0.0


@contextmanager
def _watched() -> Iterator[_Memory]:
    """Look at the process's memory a hundred times a second while the block runs (Linux)."""
    memory, done = _Memory(), threading.Event()

    def look() -> None:
        while not done.wait(0.01):
            memory.anonymous_mb = max(memory.anonymous_mb, status_megabytes("RssAnon"))
            memory.file_mb = max(memory.file_mb, status_megabytes("RssFile"))

    watcher = threading.Thread(target=look, daemon=True)
    watcher.start()
    try:
        yield memory
    finally:
        done.set()
        watcher.join()
