"""Negatives, photos that are not of the scene: whatever pose they are given is wrong."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from typing import Any

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.evaluate.dataset import PosedPhoto, Scene
from gsfeatloc_ros.evaluate.metrics import finite_numbers
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS, PhotoPrior
from gsfeatloc_ros.evaluate.scene import load_scene_renderer
from gsfeatloc_ros.index import IndexOptions, build_index
from gsfeatloc_ros.localize.engine import load_matcher
from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import MatcherSettings, RendererSettings

# Of those that have no photo behind them a few are enough.
_NOISE_PHOTOS = 4
_BLACK_PHOTOS = 2
NEGATIVES = ("mirrored", "upside-down", "mirror-pose", "noise", "black")
"""Kinds that need no other scene."""


@dataclass(frozen=True)
class NegativeOptions:
    """Which negatives are drawn.

    Attributes:
        sigma: scale of the priors' errors.
        seed: of the priors, of the noise, of the localizer and of the index.
        limit: at most this many of the photos of each scene; 0 for all.
        without_prior: whether they are looked for without a prior, by an index of the map's views.
    """

    sigma: float = 1.0
    seed: int = 0
    limit: int = 0
    without_prior: bool = False

    @property
    def kinds(self) -> tuple[str, ...]:
        """Those of NEGATIVES that are not one and the same."""
        return tuple(kind for kind in NEGATIVES if kind != "mirror-pose" or not self.without_prior)


@dataclass(frozen=True, eq=False)
class Negative:
    """A photo that the camera of a scene cannot have taken there, and where it is claimed to be from.

    Attributes:
        kind: one of NEGATIVES, or the name of the scene that it is of.
        name: of the photo.
        camera: of the photo of the scene that it stands for, `prior.photo`.
        prior: the pose that it is looked for at.
        read: reads or makes the image: (H, W, 3) uint8 RGB, of the size of `camera`; raises ValueError as
            Scene.read_photo.
    """

    kind: str
    name: str
    camera: Camera
    prior: PhotoPrior
    read: Callable[[], np.ndarray]


@dataclass(frozen=True)
class NegativeResult:
    """What a localizer made of a negative.

    Attributes:
        scene: name of the scene that it was looked for in.
        matcher: of features.
        kind, photo: kind and name of the negative.
        estimate: the localizer's.
        cpu_seconds: CPU time of the call.
    """

    scene: str
    matcher: str
    kind: str
    photo: str
    estimate: Estimate
    cpu_seconds: float

    def row(self) -> dict[str, Any]:
        """Return it without the pose, ready for JSON; None for what could not be measured."""
        return {
            "scene": self.scene,
            "matcher": self.matcher,
            "kind": self.kind,
            "photo": self.photo,
            "status": self.estimate.status.value,
            "reason": self.estimate.reason,
            **finite_numbers(self.estimate.evidence),
            "cpu_seconds": round(self.cpu_seconds, 3),
        }


def draw_negatives(scene: Scene, kind: str | Scene, options: NegativeOptions) -> list[Negative]:
    """Draw photos that are not of `scene`; the images are read when they are asked for.

    Priors are those of protocol `paper`. Of every second of the scene's own photos, mirrored or upside down, the prior
    is the pose where it was taken, from which its mirror image looks the most like the map; at a mirror pose the photo
    is mirrored and the prior on the opposite side of the scene.

    Args:
        scene: where they are looked for.
        kind: one of NEGATIVES, or another scene for its photos.
        options: how many, and their priors.
    """
    priors = PROTOCOLS["paper"](scene, options.sigma, options.seed)
    limit = options.limit or None
    if isinstance(kind, Scene):
        return [_of_scene(kind, photo, scene, priors[i % len(priors)]) for i, photo in enumerate(kind.photos[:limit])]
    if kind == "noise":
        return [_noise(scene, prior, options.seed) for prior in priors[:limit][:_NOISE_PHOTOS]]
    if kind == "black":
        return [_black(scene, prior) for prior in priors[:limit][:_BLACK_PHOTOS]]
    return [_flipped(kind, scene, prior) for prior in priors[:limit]]


def _flipped(kind: str, scene: Scene, prior: PhotoPrior) -> Negative:
    photo = scene.photos[prior.photo]
    pose = prior.T_map_camera if prior.photo % 2 else photo.T_map_camera
    if kind == "mirror-pose":
        pose = _opposite(scene, photo.T_map_camera)
    axis = 0 if kind == "upside-down" else 1

    def read() -> np.ndarray:
        return np.ascontiguousarray(np.flip(scene.read_photo(photo), axis=axis))

    return Negative(kind, photo.name, photo.camera, replace(prior, T_map_camera=pose), read)


def _opposite(scene: Scene, T_map_camera: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4) turned by half a turn about the vertical through the middle of the trajectory."""
    middle = scene.trajectory[:, :3, 3].mean(axis=0)
    down = scene.trajectory[:, :3, 1].mean(axis=0)
    turn = so3_exp(np.pi * down / np.linalg.norm(down))
    return make_pose(turn @ T_map_camera[:3, :3], middle + turn @ (T_map_camera[:3, 3] - middle))


def _of_scene(other: Scene, photo: PosedPhoto, scene: Scene, prior: PhotoPrior) -> Negative:
    camera = scene.photos[prior.photo].camera

    def read() -> np.ndarray:
        return cv2.resize(other.read_photo(photo), (camera.width, camera.height), interpolation=cv2.INTER_AREA)

    return Negative(other.name, photo.name, camera, prior, read)


def _noise(scene: Scene, prior: PhotoPrior, seed: int) -> Negative:
    camera = scene.photos[prior.photo].camera

    def make() -> np.ndarray:
        rng = np.random.default_rng([seed, prior.photo])
        return rng.integers(256, size=(camera.height, camera.width, 3), dtype=np.uint8)

    return Negative("noise", f"noise {prior.photo}", camera, prior, make)


def _black(scene: Scene, prior: PhotoPrior) -> Negative:
    camera = scene.photos[prior.photo].camera
    black = partial(np.zeros, (camera.height, camera.width, 3), np.uint8)
    return Negative("black", f"black {prior.photo}", camera, prior, black)


def localize_negatives(
    scenes: Sequence[Scene], matcher_names: Sequence[str], options: NegativeOptions
) -> Iterator[NegativeResult]:
    """Look for negatives in the maps of all scenes with all matchers, and yield what came of each.

    Raises:
        ValueError, RuntimeError, OSError: a map, a photo or a matcher's weights cannot be used.
    """
    for matcher_name in matcher_names:
        for scene in scenes:
            renderer = load_scene_renderer(scene, RendererSettings())
            matcher = load_matcher(MatcherSettings(name=matcher_name), renderer.device)
            index = build_index(renderer, matcher, IndexOptions(seed=options.seed)) if options.without_prior else None
            localizer = Localizer(renderer, matcher, LocalizerOptions(seed=options.seed), index=index)
            others = [other for other in scenes if other is not scene]
            kinds: list[str | Scene] = [*options.kinds, *others]
            drawn = [draw_negatives(scene, kind, options) for kind in kinds]
            for negative in itertools.chain.from_iterable(drawn):
                image, prior = negative.read(), negative.prior
                given = (None, None) if options.without_prior else (prior.T_map_camera, prior.covariance)
                start = time.process_time()
                estimate = localizer.localize(image, negative.camera, *given)
                seconds = time.process_time() - start
                yield NegativeResult(scene.name, matcher_name, negative.kind, negative.name, estimate, seconds)


def negative_table(results: Sequence[NegativeResult]) -> str:
    """Return a table with a line for every matcher, scene and kind of photo; the last line has the number of poses."""
    lines = ["matcher            scene      photos of    photos accepted ambiguous rejected failed  CPU-s"]
    groups: dict[tuple[str, str, str], list[NegativeResult]] = {}
    for result in results:
        groups.setdefault((result.matcher, result.scene, result.kind), []).append(result)
    for (matcher, scene, kind), group in groups.items():
        statuses = [result.estimate.status for result in group]
        counts = {status: statuses.count(status) for status in Status}
        seconds = median(result.cpu_seconds for result in group)
        lines.append(
            f"{matcher:18} {scene:10} {kind:12} {len(group):6} {counts[Status.LOCALIZED]:8} "
            f"{counts[Status.AMBIGUOUS]:9} {counts[Status.REJECTED]:8} {counts[Status.FAILED]:6}  {seconds:.2f}"
        )
    accepted = sum(result.estimate.localized for result in results)
    lines.append(f"accepted {accepted} of {len(results)}")
    return "\n".join(lines)
