"""Runs of an evaluation: photos of scenes are localized, in several processes if asked to, and the answers measured."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsfeatloc_ros.common.parameter import Value, settings_from
from gsfeatloc_ros.evaluate.ablation import ablated_localizer
from gsfeatloc_ros.evaluate.corruptions import CORRUPTIONS
from gsfeatloc_ros.evaluate.dataset import PosedPhoto, Scene
from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.evaluate.metrics import QueryResult, Scoring, measure
from gsfeatloc_ros.evaluate.priors_file import read_priors
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS, Prior, trajectory_radius
from gsfeatloc_ros.evaluate.published import PublishedLocalizer
from gsfeatloc_ros.evaluate.scene import load_scene, load_scene_renderer
from gsfeatloc_ros.localize.engine import load_matcher
from gsfeatloc_ros.localize.estimate import Trace
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import MatcherSettings, RendererSettings
from gsfeatloc_ros.match import Matcher
from gsfeatloc_ros.render import Renderer

METHODS = ("default", "published")
PRIORS_FILE = "priors-file"


@dataclass(frozen=True)
class Run:
    """One setting of everything: what a row of the tables is about.

    Attributes:
        scene: folder of the scene.
        map_path: its map; None for the one in the folder.
        protocol: one of PROTOCOLS, or PRIORS_FILE.
        priors_file: the file for PRIORS_FILE, else None.
        method: "default" (this package's) or "published".
        matcher: one of MATCHERS.
        sigma: scale of the priors' errors.
        seed: of the priors and of RANSAC.
        max_width: wider photos are resized to this many pixels.
        options: parameters of LocalizerOptions that differ from the default, with their values.
        ablation: the one of ABLATIONS that is taken out, or "".
        corruption: the one of CORRUPTIONS that is done to the photos, or "".
    """

    scene: Path
    map_path: Path | None
    protocol: str
    priors_file: Path | None
    method: str
    matcher: str
    sigma: float
    seed: int
    max_width: int
    options: tuple[tuple[str, float], ...] = ()
    ablation: str = ""
    corruption: str = ""

    def settings(self) -> dict[str, Any]:
        """Return the same, ready for JSON."""
        paths = {name: value and str(value) for name, value in asdict(self).items() if isinstance(value, Path | None)}
        return {**asdict(self), **paths, "options": dict(self.options)}

    def localizer_options(self) -> LocalizerOptions:
        """Return the options of this package's localizer."""
        values: dict[str, Value] = {"max_image_width": self.max_width, "seed": self.seed, **dict(self.options)}
        return settings_from(LocalizerOptions, values)


@dataclass(frozen=True)
class Task:
    """A photo to localize from a prior.

    Attributes:
        run: with what settings.
        version: stands for the contents of the scene's files: other ones are read anew.
        photo: its name.
        prior: its prior.
    """

    run: Run
    version: str
    photo: str
    prior: Prior


def draw_priors(run: Run, scene: Scene) -> list[Prior]:
    """Draw or read the priors of a run, in the order of the photos.

    Raises:
        ValueError: the file with the priors cannot be used.
    """
    if run.priors_file is not None:
        return read_priors(run.priors_file, scene)
    return PROTOCOLS[run.protocol](scene, run.sigma, run.seed)


def localize_all(tasks: Sequence[Task], jobs: int | None) -> Iterator[tuple[Task, QueryResult]]:
    """Localize from all priors, in any order.

    Args:
        tasks: those of one run next to each other, so that maps and matchers are loaded seldom.
        jobs: processes; None for what `joblib.parallel_config` says, else 1. The backend is joblib's default, loky,
            unless `joblib.parallel_config` says otherwise.

    Raises:
        RuntimeError: joblib is not installed, or a matcher's weights cannot be had.
        ValueError: a map or a photo cannot be used.
    """
    joblib = import_extra("joblib")
    parallel = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")
    processes = joblib.effective_n_jobs(jobs)
    # With more threads than cores they only wait for each other.
    threads = max(1, joblib.cpu_count() // processes) if processes > 1 else 0
    call = joblib.delayed(_localize_numbered)
    for number, result in parallel(call(number, task, threads) for number, task in enumerate(tasks)):
        yield tasks[number], result


def localize(task: Task, threads: int = 0) -> QueryResult:
    """Localize from one prior with at most `threads` threads (0: as many as there are cores), and measure the answer.

    Only the localization is timed, not reading the photo.
    """
    scene, photo, image = _open(task)
    prior, localizer = task.prior, _localizer(task.run, task.version, threads)
    start = time.perf_counter()
    estimate = localizer.localize(image, photo.camera, prior.T_map_camera, prior.covariance)
    milliseconds = 1000.0 * (time.perf_counter() - start)
    scoring = Scoring(trajectory_radius(scene), prior_is_answer=task.run.method == "published")
    return measure(photo, prior, estimate, milliseconds, scoring)


def trace(task: Task) -> Trace:
    """Localize from one prior, and keep the pictures that the estimate was made from."""
    _, photo, image = _open(task)
    prior, localizer = task.prior, _localizer(task.run, task.version, threads=0)
    return localizer.trace(image, photo.camera, prior.T_map_camera, prior.covariance)


@lru_cache(maxsize=1)
def open_scene(folder: Path, map_path: Path | None, version: str) -> Scene:
    """Load the scene of a run in the version of its files; kept, as the three below are, for the tasks that follow."""
    return load_scene(folder, map_path)


@lru_cache(maxsize=1)
def open_renderer(folder: Path, map_path: Path | None, version: str, threads: int = 0) -> Renderer:
    """Load the renderer of a run's map."""
    return load_scene_renderer(open_scene(folder, map_path, version), RendererSettings(threads=threads))


@lru_cache(maxsize=1)
def _matcher(name: str, device: str) -> Matcher:
    return load_matcher(MatcherSettings(name=name), device)


@lru_cache(maxsize=1)
def _localizer(run: Run, version: str, threads: int) -> Localizer | PublishedLocalizer:
    if threads:
        cv2.setNumThreads(threads)
    scene = open_scene(run.scene, run.map_path, version)
    renderer = open_renderer(run.scene, run.map_path, version, threads)
    localizer = _create_localizer(run, renderer, _matcher(run.matcher, renderer.device))
    # What is compiled or loaded at the first call does not count.
    localizer.localize(scene.read_photo(scene.photos[0]), scene.camera, scene.photos[0].T_map_camera)
    return localizer


def _create_localizer(run: Run, renderer: Renderer, matcher: Matcher) -> Localizer | PublishedLocalizer:
    if run.method == "published":
        return PublishedLocalizer(renderer, matcher, run.max_width)
    return ablated_localizer(renderer, matcher, run.localizer_options(), run.ablation)


def _open(task: Task) -> tuple[Scene, PosedPhoto, np.ndarray]:
    """Return the scene of a task, its photo, and the image (H, W, 3) uint8 RGB that the localizer is given of it."""
    run = task.run
    scene = open_scene(run.scene, run.map_path, task.version)
    photo = scene.photos[task.prior.photo]
    image = scene.read_photo(photo)
    return scene, photo, CORRUPTIONS[run.corruption](image) if run.corruption else image


def _localize_numbered(number: int, task: Task, threads: int) -> tuple[int, QueryResult]:
    return number, localize(task, threads)
