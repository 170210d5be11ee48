"""Figures of the parts that decide how fast and how right an answer is.

    python -m gsfeatloc_ros.tools.benchmark render --scene SCENE --size 640x480
    python -m gsfeatloc_ros.tools.benchmark pnp

CPU milliseconds count all threads; on a shared machine they, and ratios within one run, mean more than wall time.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.geometry import (
    invert,
    make_pose,
    random_unit_vector,
    rotation_error_deg,
    so3_exp,
    transform,
    translation_error,
)
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.pose.solve import ransac_pose
from gsfeatloc_ros.render import create_renderer

_MAX_ERROR = 3.0  # pixels
_KEYPOINT_NOISE = 0.7  # pixels
_TRIALS = 50


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(prog="benchmark", description="Measure the parts of a localization.")
    commands = parser.add_subparsers(dest="command", required=True)
    render = commands.add_parser("render", help="time of a frame, at the poses of a scene's test photos")
    render.add_argument("--scene", type=Path, required=True, help="folder with map.ply and transforms.json")
    render.add_argument(
        "--size", type=_size, default=(640, 480), metavar="WxH", help="of the frames (default: 640x480)"
    )
    render.add_argument("--threads", type=int, default=0, help="CPU threads; 0 for one per core")
    render.set_defaults(run=_render)
    commands.add_parser("pnp", help="PoseLib against OpenCV's USAC on simulated matches").set_defaults(run=_pnp)
    options = parser.parse_args(arguments)
    try:
        options.run(options)
    except (ValueError, OSError) as error:
        print(f"benchmark: {error}", file=sys.stderr)
        return 1
    return 0


def _render(options: argparse.Namespace) -> None:
    scene = load_scene(options.scene)
    gaussian_map = load_map(scene.map_path)
    renderer = create_renderer(gaussian_map, threads=options.threads, background=scene.background)
    camera = scene.camera.scaled(*options.size)
    renderer.render(camera, scene.photos[0].T_map_camera)  # compiles
    cpu, wall = zip(*(_timed(renderer.render, camera, p.T_map_camera)[1:] for p in scene.photos), strict=True)
    print(f"{scene.name}: {len(gaussian_map)} Gaussians, {camera.width}x{camera.height}, {len(cpu)} views")
    for name, seconds in (("CPU", cpu), ("wall", wall)):
        print(f"  {name:4} ms per frame: min {1e3 * min(seconds):6.1f}  median {1e3 * np.median(seconds):6.1f}")


def _pnp(_options: argparse.Namespace) -> None:
    solvers: dict[str, Callable] = {"PoseLib": _solve_with_poselib, "USAC": _solve_with_usac}
    print("matches  inliers  solver    failed  wrong   median error           CPU ms: median    max")
    for count, inlier_ratio in ((800, 0.7), (800, 0.3), (200, 0.3), (300, 0.15), (100, 0.15), (60, 0.3)):
        for name, solve in solvers.items():
            errors, times = [], []
            for seed in range(_TRIALS):
                camera, pixels, points, truth = _matches(count, inlier_ratio, seed)
                pose, cpu, _ = _timed(solve, camera, pixels, points, seed)
                times.append(1e3 * cpu)
                if pose is not None:
                    errors.append((rotation_error_deg(pose, truth), translation_error(pose, truth)))
            rotation, translation = np.transpose(errors)
            print(
                f"{count:7}  {inlier_ratio:7.0%}  {name:8}  {_TRIALS - len(errors):6}  {(rotation > 1).sum():5}   "
                f"{np.median(rotation):.4f} deg  {np.median(translation):.4f} m  "
                f"{np.median(times):14.1f} {max(times):6.1f}"
            )


def _matches(count: int, inlier_ratio: float, seed: int) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray]:
    """A camera, noisy pixels (N, 2) and points (N, 3) of which a share belongs together, and the true pose."""
    rng = np.random.default_rng(seed)
    camera = Camera(640, 426, np.array([[660.0, 0, 319.5], [0, 660.0, 212.5], [0, 0, 1]]))
    pixels = rng.uniform([0, 0], [639, 425], (count, 2))
    in_camera = camera.rays(pixels) * rng.uniform(2, 8, (count, 1))
    pixels += rng.normal(0, _KEYPOINT_NOISE, (count, 2))
    wrong = rng.random(count) >= inlier_ratio
    pixels[wrong] = rng.uniform([0, 0], [639, 425], (int(wrong.sum()), 2))
    truth = make_pose(so3_exp(rng.uniform(0, np.pi) * random_unit_vector(rng)), rng.normal(0, 3, 3))
    return camera, pixels, transform(truth, in_camera), truth


def _solve_with_poselib(camera: Camera, pixels: np.ndarray, points: np.ndarray, seed: int) -> np.ndarray | None:
    found = ransac_pose(camera, pixels, points, _MAX_ERROR, seed)
    return found[0] if found else None


def _solve_with_usac(camera: Camera, pixels: np.ndarray, points: np.ndarray, seed: int) -> np.ndarray | None:
    usac = cv2.UsacParams()
    usac.threshold, usac.maxIterations, usac.confidence = _MAX_ERROR, 10_000, 0.9999
    usac.sampler, usac.score = cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MSAC
    usac.loMethod, usac.loIterations, usac.loSampleSize = cv2.LOCAL_OPTIM_INNER_LO, 10, 50
    usac.final_polisher, usac.final_polisher_iterations = cv2.LSQ_POLISHER, 10
    usac.randomGeneratorState = seed
    try:
        solved, _, rotation, translation, _ = cv2.solvePnPRansac(points, pixels, camera.K.copy(), None, params=usac)
    except cv2.error:
        return None
    return invert(make_pose(cv2.Rodrigues(rotation)[0], translation.ravel())) if solved else None


def _timed(function: Callable, *arguments: object) -> tuple[object, float, float]:
    """Result of a call, and its CPU and wall seconds."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = function(*arguments)
    return result, time.process_time() - cpu, time.perf_counter() - wall


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) > 0 and int(height) > 0):
        raise argparse.ArgumentTypeError(f"{text} is not a size like 640x480")
    return int(width), int(height)


if __name__ == "__main__":
    sys.exit(main())
