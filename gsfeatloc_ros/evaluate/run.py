"""Runs of an evaluation: photos of scenes are localized, in several processes if asked to, and the answers measured."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.kernel_cache import hash_of_sources, user_cache_folder
from gsfeatloc_ros.common.parameter import Value, settings_from
from gsfeatloc_ros.evaluate.ablation import ablated_localizer
from gsfeatloc_ros.evaluate.corruptions import corrupt
from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.evaluate.degradations import degrade
from gsfeatloc_ros.evaluate.extras import import_extra
from gsfeatloc_ros.evaluate.metrics import Cost, QueryResult, Scoring, measure
from gsfeatloc_ros.evaluate.negatives import NEGATIVES, Negative, NegativeOptions, draw_negatives
from gsfeatloc_ros.evaluate.priors_file import read_priors
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS, PhotoPrior, trajectory_radius
from gsfeatloc_ros.evaluate.published import PublishedLocalizer
from gsfeatloc_ros.evaluate.scene import load_degraded_renderer, load_scene, load_scene_renderer
from gsfeatloc_ros.index import IndexOptions, ViewIndex, build_index
from gsfeatloc_ros.index.storage import SUFFIX
from gsfeatloc_ros.localize.engine import load_matcher
from gsfeatloc_ros.localize.estimate import Trace
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.map_index import load_or_make
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.query import Components
from gsfeatloc_ros.localize.settings import MatcherSettings, RendererSettings
from gsfeatloc_ros.match import Matcher, create_tracker
from gsfeatloc_ros.render import Renderer

METHODS = ("default", "published")
PRIORS_FILE = "priors-file"
INDICES = ("none", "map", "poses")
"""What an index of views is made of: there is none; the map alone; the poses of the training photos as well."""


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
        seed: of the priors, of RANSAC and of the places of the index's views.
        max_width: wider photos are resized to this many pixels.
        options: parameters of LocalizerOptions that differ from the default, with their values.
        ablation: the one of ABLATIONS that is taken out, or "".
        corruption: the one of CORRUPTIONS that is done to the photos, negatives too, or "".
        degradation: the one of DEGRADATIONS that is done to the map, or "".
        negative: what the photos are in place of the scene's own: one of NEGATIVES, the folder of another scene, or "".
        index: the one of INDICES in which method "default" looks for what the prior does not show.
        dataparser_transforms: nerfstudio's file, of a map in the frame that nerfstudio trained it in; else None.
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
    degradation: str = ""
    negative: str = ""
    index: str = "none"
    dataparser_transforms: Path | None = None

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
    prior: PhotoPrior

    @property
    def drawn_map(self) -> DrawnMap:
        """The map that it is localized in."""
        run = self.run
        seed = run.seed if run.degradation else 0
        return DrawnMap(run.scene, run.map_path, self.version, run.degradation, seed, run.dataparser_transforms)


@dataclass(frozen=True)
class DrawnMap:
    """A map that is drawn: of a scene in the version of its files, with a degradation ("" for none) and its seed.

    The last is nerfstudio's file of where it lies, if there is one.
    """

    scene: Path
    map_path: Path | None
    version: str
    degradation: str = ""
    seed: int = 0
    dataparser_transforms: Path | None = None


def draw_priors(run: Run, scene: Scene) -> list[PhotoPrior]:
    """Draw or read the priors of a run, in the order of the photos.

    Raises:
        ValueError: the file with the priors cannot be used.
    """
    if run.priors_file is not None:
        return read_priors(run.priors_file, scene)
    return PROTOCOLS[run.protocol](scene, run.sigma, run.seed)


def load_negative_scene(run: Run) -> Scene | None:
    """Load the scene that the negatives of a run are photos of; None where they are of no other scene.

    Raises:
        ValueError, RuntimeError: as load_scene.
    """
    if not run.negative or run.negative in NEGATIVES:
        return None
    # Its own map is not needed.
    return load_scene(run.negative, run.map_path or run.negative)


def run_negatives(run: Run, scene: Scene, other: Scene | None) -> list[Negative]:
    """Draw the negatives of a run, all that there are; `other` as load_negative_scene."""
    return draw_negatives(scene, other or run.negative, NegativeOptions(run.sigma, run.seed))


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
    scene, (image, camera) = _open(task)
    run, prior = task.run, task.prior
    localizer = _localizer(_localizer_of(run), task.drawn_map, threads)
    start, cpu_start = time.perf_counter(), time.process_time()
    estimate = localizer.localize(image, camera, *_given(prior))
    cost = Cost(1000.0 * (time.perf_counter() - start), 1000.0 * (time.process_time() - cpu_start))
    photo = replace(scene.photos[prior.photo], name=task.photo)
    scoring = Scoring(trajectory_radius(scene), run.method == "published", bool(run.negative))
    return measure(photo, prior, estimate, cost, scoring)


def trace(task: Task) -> Trace:
    """Localize from one prior, and keep the pictures that the estimate was made from."""
    _, (image, camera) = _open(task)
    localizer = _localizer(_localizer_of(task.run), task.drawn_map, threads=0)
    return localizer.trace(image, camera, *_given(task.prior))


def _given(prior: PhotoPrior) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the pose and the covariance that the localizer is told."""
    return (prior.T_map_camera, prior.covariance) if prior.given else (None, None)


@lru_cache(maxsize=1)
def open_scene(folder: Path, map_path: Path | None, version: str) -> Scene:
    """Load the scene of a run in the version of its files; kept, as the three below are, for the tasks that follow."""
    return load_scene(folder, map_path)


@lru_cache(maxsize=1)
def open_renderer(drawn: DrawnMap, threads: int = 0) -> Renderer:
    """Load the renderer of a map."""
    scene, settings = open_scene(drawn.scene, drawn.map_path, drawn.version), RendererSettings(threads=threads)
    if drawn.degradation:
        return load_degraded_renderer(
            scene,
            settings,
            partial(degrade, drawn.degradation, scene=scene, seed=drawn.seed),
            drawn.dataparser_transforms,
        )
    return load_scene_renderer(scene, settings, drawn.dataparser_transforms)


@lru_cache(maxsize=1)
def _matcher(name: str, device: str) -> Matcher:
    return load_matcher(MatcherSettings(name=name), device)


def _localizer_of(run: Run) -> Run:
    """Return the run with the same localizer whose photos and priors are the plain ones."""
    return replace(run, protocol="paper", priors_file=None, sigma=1.0, corruption="", negative="")


@lru_cache(maxsize=1)
def _localizer(run: Run, drawn: DrawnMap, threads: int) -> Localizer | PublishedLocalizer:
    if threads:
        cv2.setNumThreads(threads)
    scene = open_scene(drawn.scene, drawn.map_path, drawn.version)
    renderer = open_renderer(drawn, threads)
    localizer = _create_localizer(run, drawn, renderer, _matcher(run.matcher, renderer.device))
    # What is compiled or loaded at the first call does not count.
    localizer.localize(scene.read_photo(scene.photos[0]), scene.camera, scene.photos[0].T_map_camera)
    return localizer


def _create_localizer(
    run: Run, drawn: DrawnMap, renderer: Renderer, matcher: Matcher
) -> Localizer | PublishedLocalizer:
    if run.method == "published":
        return PublishedLocalizer(renderer, matcher, run.max_width)
    index = None if run.index == "none" else _index(run, drawn, renderer, matcher)
    return ablated_localizer(
        Components(renderer, matcher, create_tracker, run.localizer_options(), index), run.ablation
    )


def _index(run: Run, drawn: DrawnMap, renderer: Renderer, matcher: Matcher) -> ViewIndex:
    """Make the index of views of a run's map by the run's seed, or read it where that was done before."""
    scene = open_scene(drawn.scene, drawn.map_path, drawn.version)
    poses = scene.training_poses() if run.index == "poses" else None
    made_of = [str(drawn), run.matcher, run.index, run.seed, hash_of_sources("index", "match", "render", "maps")]
    name = hashlib.sha256(repr(made_of).encode()).hexdigest()[:16]
    path = user_cache_folder() / "evaluate" / f"{scene.name}-{name}{SUFFIX}"
    options = IndexOptions(seed=run.seed)
    return load_or_make(path, {"made of": made_of}, lambda: build_index(renderer, matcher, options, poses=poses))


def _open(task: Task) -> tuple[Scene, tuple[np.ndarray, Camera]]:
    """Return the scene of a task, and the image (H, W, 3) uint8 RGB with its camera that the localizer is given."""
    run = task.run
    scene = open_scene(run.scene, run.map_path, task.version)
    if run.negative:
        negative = _negatives(run, task.version)[task.photo]
        image, camera = negative.read(), negative.camera
    else:
        photo = scene.photos[task.prior.photo]
        image, camera = scene.read_photo(photo), photo.camera
    if run.corruption:
        return scene, corrupt(run.corruption, image, camera, (run.seed, task.prior.photo))
    return scene, (image, camera)


@lru_cache(maxsize=1)
def _negatives(run: Run, version: str) -> dict[str, Negative]:
    """Return the negatives of a run by the name of the photo."""
    scene = open_scene(run.scene, run.map_path, version)
    return {negative.name: negative for negative in run_negatives(run, scene, load_negative_scene(run))}


def _localize_numbered(number: int, task: Task, threads: int) -> tuple[int, QueryResult]:
    return number, localize(task, threads)
