"""Frames of a map, and how it is loaded."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.benchmark.measure import finish, memory_taken, spread, stage_time, timed
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.localize.first_run import warm_up
from gsfeatloc_ros.localize.settings import RendererSettings
from gsfeatloc_ros.maps import GaussianMap, load_map
from gsfeatloc_ros.render import DrawOptions, Render, SplatRenderer, create_renderer
from gsfeatloc_ros.render.cache import load_prepared
from gsfeatloc_ros.render.chunks import PreparedMap

Size = tuple[int, int]

_FIELD_OF_VIEW = 65.0  # degrees, horizontal
# A view of a whole map leaves this fraction of the Gaussians out on each side.
_OUTSIDE_FRACTION = 0.05
# The first frames grow the renderer's buffers.
UNCOUNTED_FRAMES = 2


def measure_map(
    path: Path, size: Size, pose: np.ndarray | None, frames: int, settings: RendererSettings
) -> dict[str, Any]:
    """Load a map, draw the same frame again and again, and load it once more from a cache.

    Args:
        path: the map.
        size: width and height of the frame, pixels.
        pose: (4, 4) T_map_camera; None for one from which the whole map is in view.
        frames: how many are measured.
        settings: of the renderer.

    Raises:
        ValueError, OSError: the map or the device cannot be used.
    """
    gaussian_map = load_map(path)
    if pose is None:
        pose = view_of_all(gaussian_map)
    report = {
        "map": path.name,
        "gaussians": len(gaussian_map),
        "sh_degree": gaussian_map.sh_degree,
        "parameters_mb": sum(v.nbytes for v in vars(gaussian_map).values() if isinstance(v, np.ndarray)) / 2**20,
    }
    del gaussian_map
    warm_up(device=settings.device, threads=settings.threads)
    renderer, cold = _measure_load(lambda: _create_renderer(load_map(path), settings))
    report |= measure_frames(renderer, pinhole(size), [pose] * frames)
    del renderer
    with tempfile.TemporaryDirectory() as folder:
        cache_path = Path(folder) / "cache"
        load_prepared(path, cache_path=cache_path)
        cached = _measure_load(lambda: _create_renderer(load_prepared(path, cache_path=cache_path), settings))[1]
    return report | {"load": {"cold": cold, "from_cache": cached}}


def _create_renderer(
    gaussian_map: GaussianMap | PreparedMap,
    settings: RendererSettings,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> SplatRenderer:
    options = DrawOptions(background, settings.sh_degree, settings.resolution_scale)
    return create_renderer(gaussian_map, settings.device, settings.threads, options)


def _measure_load(load: Callable[[], SplatRenderer]) -> tuple[SplatRenderer, dict[str, float]]:
    """Load a map, with the seconds and megabytes that it takes."""
    with memory_taken() as memory:
        loaded = timed(load)
    figures = {
        "seconds": 1e-3 * loaded.wall,
        "cpu_seconds": 1e-3 * loaded.cpu,
        "peak_mb": memory.peak,
        "kept_mb": memory.after,
    }
    return loaded.result, figures


def measure_scene(path: Path, size: Size, settings: RendererSettings) -> dict[str, Any]:
    """Draw a frame at the pose of each test photo of a scene, with the first one's camera at `size`.

    Raises:
        ValueError, OSError: the scene or the device cannot be used.
    """
    scene = load_scene(path)
    gaussian_map = load_map(scene.map_path)
    renderer = _create_renderer(gaussian_map, settings, scene.background)
    poses = [photo.T_map_camera for photo in scene.photos]
    report = {"map": scene.name, "gaussians": len(gaussian_map), "sh_degree": gaussian_map.sh_degree}
    return report | measure_frames(renderer, scene.camera.scaled(*size), poses)


def measure_frames(renderer: SplatRenderer, camera: Camera, poses: list[np.ndarray]) -> dict[str, Any]:
    """Measure frames at `poses`, (4, 4) each: milliseconds, those by stage (mean), coverage of the last one."""

    def draw(pose: np.ndarray) -> Render:
        render = renderer.render(camera, pose)
        finish(renderer.device)
        return render

    for pose in poses[:UNCOUNTED_FRAMES]:
        draw(pose)
    frames = [timed(draw, pose) for pose in poses]
    # Apart from the others, whose time this is not to cost.
    time_of_stages, now = stage_time(renderer.device)
    clock = StageClock(now)
    for pose in poses:
        renderer.render(camera, pose, clock.stage)
    stages = {name: ms / len(poses) for name, ms in clock.milliseconds().items() if name != "total"}
    return {
        "size": [camera.width, camera.height],
        "frames": len(frames),
        "cpu_ms": spread([frame.cpu for frame in frames]),
        "wall_ms": spread([frame.wall for frame in frames]),
        f"stages_{time_of_stages}_ms": stages,
        "coverage": float(frames[-1].result.alpha.mean()),
    }


def print_frames(report: dict[str, Any]) -> None:
    """Print what measure_map or measure_scene found."""
    width, height = report["size"]
    print(f"{report['map']}: {report['gaussians']} Gaussians of SH degree {report['sh_degree']}, {width}x{height}")
    for name, times in (("CPU", report["cpu_ms"]), ("wall", report["wall_ms"])):
        print(f"  {name:4} ms of {report['frames']} frames: min {times['min']:6.1f}  median {times['median']:6.1f}")
    for key, name in (("stages_cpu_ms", "CPU "), ("stages_wall_ms", "wall")):
        if key in report:
            stages = ", ".join(f"{stage} {milliseconds:.1f}" for stage, milliseconds in report[key].items())
            print(f"  {name} ms by stage, mean: {stages}")
    for name, figures in report.get("load", {}).items():
        print(
            f"  {name.replace('_', ' ')}: ready to render in {figures['seconds']:.2f} s, at most "
            f"{figures['peak_mb']:.0f} MB, {figures['kept_mb']:.0f} MB kept "
            f"(the parameters: {report['parameters_mb']:.0f} MB)"
        )


def pinhole(size: Size) -> Camera:
    """Return a camera of width and height `size` with a usual field of view."""
    width, height = size
    focal = 0.5 * width / np.tan(np.radians(0.5 * _FIELD_OF_VIEW))
    return Camera.centred(width, height, focal)


def view_of_all(gaussian_map: GaussianMap) -> np.ndarray:
    """Return a pose (4, 4) T_map_camera, along the z axis of the file, with nearly all of the map in view."""
    low, high = np.quantile(gaussian_map.means, [_OUTSIDE_FRACTION, 1 - _OUTSIDE_FRACTION], axis=0)
    distance = np.max(high - low) / np.tan(np.radians(0.5 * _FIELD_OF_VIEW))
    position = 0.5 * (low + high) - [0, 0, distance]
    return gaussian_map.S_map_splat.transform_pose(make_pose(np.eye(3), position))
