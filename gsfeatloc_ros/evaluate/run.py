"""Localizes the photos of scenes, in several processes if asked to, and measures the answers."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import cv2

from gsfeatloc_ros.evaluate.ablation import MeanDepthRenderer, without
from gsfeatloc_ros.evaluate.corruptions import SPOILERS
from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.evaluate.metrics import QueryResult, measure
from gsfeatloc_ros.evaluate.priors_file import read_priors
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS, Prior, trajectory_radius
from gsfeatloc_ros.evaluate.published import PublishedLocalizer
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.localize.localizer import Localizer, LocalizerOptions
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.match import Matcher, create_matcher
from gsfeatloc_ros.render import DrawOptions, Renderer, create_renderer

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
        options: fields of LocalizerOptions that differ from the default, with their values.
        without: the one of ablation.PIECES that is taken out, or "".
        spoil: what is made wrong with the photos, one of SPOILERS, or "".
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
    without: str = ""
    spoil: str = ""

    def settings(self) -> dict:
        """The same, ready for JSON."""
        paths = {name: value and str(value) for name, value in asdict(self).items() if isinstance(value, Path | None)}
        return {**asdict(self), **paths, "options": dict(self.options)}


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


def create_localizer(
    method: str,
    renderer: Renderer,
    matcher: Matcher,
    max_image_width: int,
    seed: int,
    options: Sequence[tuple[str, float]] = (),
) -> Localizer | PublishedLocalizer:
    """Make the localizer of a method, "default" (this package's, with changed `options`) or "published"."""
    if method == "published":
        return PublishedLocalizer(renderer, matcher, max_image_width)
    return Localizer(renderer, matcher, LocalizerOptions(max_image_width=max_image_width, seed=seed, **dict(options)))


def draw_priors(run: Run, scene: Scene) -> list[Prior]:
    """The priors of a run, in the order of the photos.

    Raises:
        ValueError: the file with the priors cannot be used.
    """
    if run.protocol == PRIORS_FILE:
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


def localize(task: Task, threads: int = 0) -> tuple[QueryResult, Estimate]:
    """Localize from one prior with at most `threads` threads (0: as many as there are cores).

    Only the localization is timed, not reading the photo.
    """
    run, prior = task.run, task.prior
    scene = open_scene(run.scene, run.map_path, task.version)
    localizer = _localizer(run, task.version, threads)
    photo = scene.photos[prior.photo]
    image = scene.read_photo(photo)
    if run.spoil:
        image = SPOILERS[run.spoil](image)
    start = time.perf_counter()
    with without(run.without, _matcher(run.matcher, threads)):
        if isinstance(localizer, Localizer):
            estimate = localizer.localize(image, photo.camera, prior.T_map_camera, prior.covariance)
        else:
            estimate = localizer.localize(image, photo.camera, prior.T_map_camera)
    milliseconds = 1000.0 * (time.perf_counter() - start)
    result = measure(
        photo.name,
        estimate,
        photo.T_map_camera,
        prior.T_map_camera,
        trajectory_radius(scene),
        milliseconds,
        prior_is_answer=run.method == "published",
        step=prior.step,
    )
    return result, estimate


@lru_cache(maxsize=1)
def open_scene(folder: Path, map_path: Path | None, version: str) -> Scene:
    """The scene of a run in the version of its files; kept, as the three below are, for the tasks that follow."""
    return load_scene(folder, map_path)


@lru_cache(maxsize=1)
def open_renderer(map_path: Path, background: tuple[float, float, float], version: str, threads: int = 0) -> Renderer:
    """The renderer of a map."""
    return create_renderer(load_map(map_path), threads=threads, options=DrawOptions(background))


@lru_cache(maxsize=1)
def _matcher(name: str, threads: int) -> Matcher:
    if threads:
        cv2.setNumThreads(threads)
    return create_matcher(name)


@lru_cache(maxsize=1)
def _localizer(run: Run, version: str, threads: int) -> Localizer | PublishedLocalizer:
    scene = open_scene(run.scene, run.map_path, version)
    renderer = open_renderer(scene.map_path, scene.background, version, threads)
    matcher = _matcher(run.matcher, threads)
    if run.without == "median-depth":
        renderer = MeanDepthRenderer(renderer)
    localizer = create_localizer(run.method, renderer, matcher, run.max_width, run.seed, run.options)
    # What is compiled or loaded at the first call does not count.
    localizer.localize(scene.read_photo(scene.photos[0]), scene.camera, scene.photos[0].T_map_camera)
    return localizer


def _localize_numbered(number: int, task: Task, threads: int) -> tuple[int, QueryResult]:
    return number, localize(task, threads)[0]
