"""Time of localizations whose prior is good: near the truth, and carried from answer to answer along a path."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.benchmark.measure import Timed, stage_time, timed
from gsfeatloc_ros.benchmark.query import print_times, times_of
from gsfeatloc_ros.common.geometry import moved, random_unit_vector, rotation_error_deg, translation_error
from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.evaluate.protocol import PriorError, trajectory_radius
from gsfeatloc_ros.evaluate.scene import load_scene, load_scene_renderer
from gsfeatloc_ros.localize.engine import load_matcher
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.settings import MatcherSettings, RendererSettings
from gsfeatloc_ros.render import Renderer

# Priors near the truth are off by up to this, uniformly: degrees, and shares of the trajectory's radius.
_NEAR_ROTATION, _NEAR_TRANSLATION = 3.0, 0.02
# The path swings by this about the pose of the first photo, once in so many frames.
_SWING_ROTATION, _SWING_TRANSLATION, _PERIOD = 15.0, 0.1, 120
# Standard deviation of the noise of its photos, of 255, and how much darker than the map they are.
_NOISE, _GAIN = 4.0, 0.8


def measure_tracking(scene_path: Path, frames: int, settings: RendererSettings) -> dict[str, Any]:
    """Localize the test photos of a scene from priors near the truth, and a camera on a smooth path in its map.

    On the path, photos are renders of the map, darker and with noise. The prior is the last answer; its covariance
    grows by what the camera moves in a frame.

    Returns:
        Of "near" and of "path": as times_of; of the path its largest errors, in degrees and radii, too.

    Raises:
        ValueError, OSError, RuntimeError: the scene or the device cannot be used.
    """
    scene = load_scene(scene_path)
    renderer = load_scene_renderer(scene, settings)
    matcher = load_matcher(MatcherSettings(), renderer.device)
    clock, now = stage_time(renderer.device)
    localizer = Localizer(renderer, matcher, now=now)
    near = list(_near(scene, localizer))
    path = list(_along_path(scene, renderer, localizer, frames))
    found = [(query.result.T_map_camera, truth) for query, truth in path if query.result.T_map_camera is not None]
    radius = trajectory_radius(scene)
    return {
        "scene": scene.name,
        # What is compiled or loaded at the first call does not count.
        "near": times_of(near[1:] or near, clock),
        "path": times_of([query for query, _ in path[1:] or path], clock)
        | {
            "max_error_deg": max((rotation_error_deg(pose, truth) for pose, truth in found), default=float("nan")),
            "max_error_radii": max((translation_error(*pair) / radius for pair in found), default=float("nan")),
        },
    }


def print_tracking(report: dict[str, Any]) -> None:
    """Print what measure_tracking found."""
    print_times(
        f"{report['scene']}, priors within {_NEAR_ROTATION:g} degrees and {_NEAR_TRANSLATION:g}", report["near"]
    )
    path = report["path"]
    print_times(f"{report['scene']}, along a path", path)
    print(f"  errors   at most {path['max_error_deg']:.3f} degrees, {path['max_error_radii']:.4f} radii")


def _near(scene: Scene, localizer: Localizer) -> Iterator[Timed[Estimate]]:
    """Localize each photo, the first one twice, from a prior near its pose."""
    radius = trajectory_radius(scene)
    bound = PriorError(np.radians(_NEAR_ROTATION), _NEAR_TRANSLATION * radius)
    # The variance of what is uniformly distributed from 0 to a bound about 0.
    covariance = bound.covariance / 3
    for index in [0, *range(len(scene.photos))]:
        photo, rng = scene.photos[index], np.random.default_rng(index)
        translation = rng.uniform(0, bound.translation) * random_unit_vector(rng)
        rotation = rng.uniform(0, bound.rotation) * random_unit_vector(rng)
        prior = moved(photo.T_map_camera, np.concatenate([translation, rotation]))
        yield timed(localizer.localize, scene.read_photo(photo), photo.camera, prior, covariance)


def _along_path(
    scene: Scene, renderer: Renderer, localizer: Localizer, frames: int
) -> Iterator[tuple[Timed[Estimate], np.ndarray]]:
    """Localize a camera on a path, frame by frame; yield the true pose (4, 4) of each with what was found."""
    camera, radius = scene.photos[0].camera.pinhole(), trajectory_radius(scene)
    rng = np.random.default_rng(0)
    rate = 2 * np.pi / _PERIOD
    step = PriorError(rate * np.radians(_SWING_ROTATION), rate * _SWING_TRANSLATION * radius)
    pose, covariance = scene.photos[0].T_map_camera, step.covariance
    for frame in range(frames):
        angle = rate * frame
        swing = np.array([np.sin(angle), 0.5 * np.sin(2 * angle), 1 - np.cos(angle)])
        truth = moved(
            scene.photos[0].T_map_camera,
            np.concatenate([_SWING_TRANSLATION * radius * swing, np.radians(_SWING_ROTATION) * swing[::-1]]),
        )
        light = 255 * _GAIN * renderer.render(camera, truth).on_host().rgb
        image = np.clip(light + rng.normal(0, _NOISE, light.shape), 0, 255).astype(np.uint8)
        query = timed(localizer.localize, image, camera, pose, covariance)
        if query.result.T_map_camera is not None and query.result.covariance is not None:
            pose, covariance = query.result.T_map_camera, query.result.covariance + step.covariance
        yield query, truth
