"""Negatives, photos that are not of the scene: whatever pose they are given is wrong."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.evaluate.metrics import finite_numbers
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS, Prior
from gsfeatloc_ros.evaluate.scene import load_scene_renderer
from gsfeatloc_ros.localize.engine import load_matcher
from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import MatcherSettings, RendererSettings

# Of those that have no photo behind them a few are enough.
_NOISE_PHOTOS = 4
_BLACK_PHOTOS = 2


@dataclass(frozen=True)
class NegativeOptions:
    """Which negatives are drawn.

    Attributes:
        sigma: scale of the priors' errors.
        seed: of the priors, of the noise and of the localizer.
        limit: at most this many of the photos of each scene; 0 for all.
    """

    sigma: float = 1.0
    seed: int = 0
    limit: int = 0


@dataclass(frozen=True, eq=False)
class Negative:
    """A photo that the camera of a scene cannot have taken there, and where it is claimed to be from.

    Attributes:
        kind: "mirrored", "upside-down", "noise", "black" or the name of the scene that it is of.
        name: of the photo.
        image: (H, W, 3) uint8 RGB, of the size of `camera`.
        camera: of the photo of the scene that it stands for.
        prior: the pose that it is looked for at.
    """

    kind: str
    name: str
    image: np.ndarray
    camera: Camera
    prior: Prior


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


def draw_negatives(scene: Scene, others: Sequence[Scene], options: NegativeOptions) -> Iterator[Negative]:
    """Draw photos that are not of `scene`, one at a time.

    They are its own photos, mirrored and upside down, the photos of other scenes, noise and black. Priors are those of
    protocol `paper`; of every second of the scene's own photos the prior is the pose where it was taken, from which its
    mirror image looks the most like the map.

    Args:
        scene: where they are looked for.
        others: what the others are of.
        options: how many, and their priors.
    """
    limit = options.limit or None
    priors = PROTOCOLS["paper"](scene, options.sigma, options.seed)[:limit]
    rng = np.random.default_rng(options.seed)
    for kind, axis in (("mirrored", 1), ("upside-down", 0)):
        for index, prior in enumerate(priors):
            photo = scene.photos[index]
            image = np.ascontiguousarray(np.flip(scene.read_photo(photo), axis=axis))
            pose = prior.T_map_camera if index % 2 else photo.T_map_camera
            yield Negative(kind, photo.name, image, photo.camera, Prior(index, 0, pose, prior.covariance))
    for other in others:
        for number, photo in enumerate(other.photos[:limit]):
            prior = priors[number % len(priors)]
            camera = scene.photos[prior.photo].camera
            image = cv2.resize(other.read_photo(photo), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
            yield Negative(other.name, photo.name, image, camera, prior)
    for kind, count, brightest in (("noise", _NOISE_PHOTOS, 256), ("black", _BLACK_PHOTOS, 1)):
        for index, prior in enumerate(priors[:count]):
            camera = scene.photos[index].camera
            image = rng.integers(brightest, size=(camera.height, camera.width, 3), dtype=np.uint8)
            yield Negative(kind, f"{kind} {index}", image, camera, prior)


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
            localizer = Localizer(renderer, matcher, LocalizerOptions(seed=options.seed))
            others = [other for other in scenes if other is not scene]
            for negative in draw_negatives(scene, others, options):
                start = time.process_time()
                estimate = localizer.localize(
                    negative.image, negative.camera, negative.prior.T_map_camera, negative.prior.covariance
                )
                seconds = time.process_time() - start
                yield NegativeResult(scene.name, matcher_name, negative.kind, negative.name, estimate, seconds)


def negative_table(results: Sequence[NegativeResult]) -> str:
    """Return a table with a line for every matcher, scene and kind of photo; the last line has the number of poses."""
    lines = ["matcher            scene      photos of    photos accepted rejected failed  CPU-s"]
    groups: dict[tuple[str, str, str], list[NegativeResult]] = {}
    for result in results:
        groups.setdefault((result.matcher, result.scene, result.kind), []).append(result)
    for (matcher, scene, kind), group in groups.items():
        statuses = [result.estimate.status for result in group]
        accepted, rejected, failed = (statuses.count(status) for status in Status)
        seconds = median(result.cpu_seconds for result in group)
        lines.append(
            f"{matcher:18} {scene:10} {kind:12} {len(group):6} {accepted:8} {rejected:8} {failed:6}  {seconds:.2f}"
        )
    accepted = sum(result.estimate.localized for result in results)
    lines.append(f"accepted {accepted} of {len(results)}")
    return "\n".join(lines)
