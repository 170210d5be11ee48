"""Photos that are not of the scene: whatever pose they are given is wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS, Prior

# Of those that have no photo behind them a few are enough.
_NOISE_PHOTOS = 4
_BLACK_PHOTOS = 2


@dataclass(frozen=True, eq=False)
class Stranger:
    """A photo that the camera of a scene cannot have taken there, and where it is claimed to be from.

    Attributes:
        kind: "mirrored", "upside-down", "noise", "black" or the name of the scene that it is of.
        name: of the photo.
        image: (H, W, 3) uint8 RGB, of the size of the camera of the photo that it stands for.
        photo: index of that photo in the scene.
        prior: the pose that it is looked for at.
    """

    kind: str
    name: str
    image: np.ndarray
    photo: int
    prior: Prior


def draw_strangers(scene: Scene, others: Sequence[Scene], sigma: float, seed: int, limit: int) -> Iterator[Stranger]:
    """Photos that are not of `scene`, one at a time.

    They are its own photos, mirrored and upside down, the photos of other scenes, noise and black. Priors are those of
    protocol `paper`; of every second of the scene's own photos the prior is the pose where it was taken, from which its
    mirror image looks the most like the map.

    Args:
        scene: where they are looked for.
        others: what the others are of.
        sigma, seed: of the priors.
        limit: at most this many of the photos of each scene; 0 for all.
    """
    priors = PROTOCOLS["paper"](scene, sigma, seed)[: limit or None]
    rng = np.random.default_rng(seed)
    for kind, axis in (("mirrored", 1), ("upside-down", 0)):
        for index, prior in enumerate(priors):
            photo = scene.photos[index]
            image = np.ascontiguousarray(np.flip(scene.read_photo(photo), axis=axis))
            pose = prior.T_map_camera if index % 2 else photo.T_map_camera
            yield Stranger(kind, photo.name, image, index, Prior(index, 0, pose, prior.covariance))
    for other in others:
        for number, photo in enumerate(other.photos[: limit or None]):
            index = number % len(priors)
            camera = scene.photos[index].camera
            image = cv2.resize(other.read_photo(photo), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
            yield Stranger(other.name, photo.name, image, index, priors[index])
    for kind, count, brightest in (("noise", _NOISE_PHOTOS, 256), ("black", _BLACK_PHOTOS, 1)):
        for index, prior in enumerate(priors[:count]):
            camera = scene.photos[index].camera
            image = rng.integers(brightest, size=(camera.height, camera.width, 3), dtype=np.uint8)
            yield Stranger(kind, f"{kind} {index}", image, index, prior)
