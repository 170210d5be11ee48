"""PoseLib against OpenCV's USAC, on simulated matches."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from gsfeatloc_ros.benchmark.measure import timed
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import (
    invert,
    make_pose,
    random_unit_vector,
    rotation_error_deg,
    so3_exp,
    transform,
    translation_error,
)
from gsfeatloc_ros.pose.solve import Correspondences, ransac_pose

_MAX_ERROR = 3.0  # pixels
_KEYPOINT_NOISE = 0.7  # pixels
_TRIALS = 50
# Matches and the share of them that is right.
_PROBLEMS = ((800, 0.7), (800, 0.3), (200, 0.3), (300, 0.15), (100, 0.15), (60, 0.3))


def measure_pnp() -> None:
    """Print a table of how often and how fast each solver is right."""
    solvers: dict[str, Callable] = {"PoseLib": _solve_with_poselib, "USAC": _solve_with_usac}
    print("matches  inliers  solver    failed  wrong   median error           CPU ms: median    max")
    for count, inlier_ratio in _PROBLEMS:
        for name, solve in solvers.items():
            errors, times = [], []
            for seed in range(_TRIALS):
                camera, pixels, points, truth = _matches(count, inlier_ratio, seed)
                solved = timed(solve, camera, pixels, points, seed)
                times.append(solved.cpu)
                if solved.result is not None:
                    errors.append((rotation_error_deg(solved.result, truth), translation_error(solved.result, truth)))
            rotation, translation = np.transpose(errors)
            print(
                f"{count:7}  {inlier_ratio:7.0%}  {name:8}  {_TRIALS - len(errors):6}  {(rotation > 1).sum():5}   "
                f"{np.median(rotation):.4f} deg  {np.median(translation):.4f} m  "
                f"{np.median(times):14.1f} {max(times):6.1f}"
            )


def _matches(count: int, inlier_ratio: float, seed: int) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray]:
    """Return a camera, noisy pixels (N, 2) and points (N, 3) of which a share belongs together, and the true pose."""
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
    matches = Correspondences(pixels, points, np.zeros_like(points))
    found = ransac_pose(camera, matches, _MAX_ERROR, seed)
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
