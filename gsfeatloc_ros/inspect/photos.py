"""How well a map predicts its own photos, and which of two readings of its file predicts them better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.evaluate.dataset import PosedPhoto, Scene
from gsfeatloc_ros.localize.engine import load_renderer
from gsfeatloc_ros.localize.settings import MapSettings, RendererSettings
from gsfeatloc_ros.render.base import Renderer

# Of more photos, these are taken evenly.
_MAX_PHOTOS = 24
# A reading fits better where it gains so many decibels on average, and twice the standard error of that.
_MIN_GAIN = 0.1
_MIN_SIGMAS = 2.0
_MAX_PSNR = 100.0


@dataclass(frozen=True)
class Comparison:
    """Two readings of a map's file.

    Attributes:
        parameter: of the node, that says which.
        values: of the parameter, two.
        psnr: mean over the photos of each, in decibels.
        gain: of the second over the first, mean over the photos.
        sigma: standard error of the gain.
    """

    parameter: str
    values: tuple[str, str]
    psnr: tuple[float, float]
    gain: float
    sigma: float

    @property
    def better(self) -> str | None:
        """The value that fits better; None where the photos do not tell."""
        if abs(self.gain) < max(_MIN_GAIN, _MIN_SIGMAS * self.sigma):
            return None
        return self.values[self.gain > 0]

    @property
    def advice(self) -> str:
        """What to set."""
        if self.better is None:
            return f"the photos do not tell {self.parameter}: leave it as it is"
        return f"set {self.parameter}:={self.better}, unless it is read so already"


@dataclass(frozen=True)
class PhotoFit:
    """How well the map predicts photos.

    Attributes:
        scene: its name.
        names: of the photos.
        psnr: in decibels after the exposure of each photo is fitted, as the file is read.
        comparisons: of readings.
    """

    scene: str
    names: list[str]
    psnr: list[float]
    comparisons: list[Comparison]


def fit_photos(scene: Scene, map_: MapSettings, renderer: RendererSettings, is_spz: bool, max_width: int) -> PhotoFit:
    """Compare photos of a scene with renders at their poses.

    Args:
        scene: with photos, whose poses are in the frame of the map's file.
        map_: the map, and how it is read.
        renderer: how it is drawn.
        is_spz: whether the file leaves its axes open.
        max_width: to which wider photos are resized. As wide as the map was trained on is best: what a map is blurred
            by, and so whether it seems antialiased, is counted in pixels.

    Raises:
        ValueError, OSError, RuntimeError: a photo, or the map read otherwise, cannot be used.
    """
    in_file_frame = MapSettings(path=map_.path, reading=map_.reading, cache=False)
    photos = scene.photos[:: -(-len(scene.photos) // _MAX_PHOTOS)]

    def psnr(**reading: Any) -> list[float]:
        settings = replace(in_file_frame, reading=replace(in_file_frame.reading, **reading))
        return _psnr(scene, photos, load_renderer(settings, renderer, scene.background), max_width)

    readings = {"antialiased": ("false", "true")} | ({"spz_axes": ("rub", "ply")} if is_spz else {})
    comparisons = [
        _compare(f"map.{name}", values, [psnr(**{name: value}) for value in values])
        for name, values in readings.items()
    ]
    return PhotoFit(scene.name, [photo.name for photo in photos], psnr(), comparisons)


def _compare(parameter: str, values: tuple[str, str], psnr: Sequence[Sequence[float]]) -> Comparison:
    first, second = np.array(psnr)
    gains = second - first
    sigma = float(gains.std(ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else 0.0
    return Comparison(parameter, values, (float(first.mean()), float(second.mean())), float(gains.mean()), sigma)


def _psnr(scene: Scene, photos: Sequence[PosedPhoto], renderer: Renderer, max_width: int) -> list[float]:
    found = []
    for photo in photos:
        image, camera = photo.camera.limit(scene.read_photo(photo), max_width)
        inside = camera.seen()
        seen = camera.undistort_image(image)[inside] / 255.0
        drawn = to_host(renderer.render(camera.pinhole(), photo.T_map_camera).rgb)[inside]
        found.append(aligned_psnr(seen, drawn))
    return found


def aligned_psnr(photo: np.ndarray, render: np.ndarray) -> float:
    """Return the PSNR, in decibels, of colours (N, 3) in [0, 1] once gain and offset of each channel are fitted."""
    error = 0.0
    for seen, drawn in zip(photo.T, render.astype(np.float64).T, strict=True):
        gain, offset = np.linalg.lstsq(np.column_stack([drawn, np.ones(len(drawn))]), seen, rcond=None)[0]
        error += float(np.mean((np.clip(gain * drawn + offset, 0, 1) - seen) ** 2)) / 3
    return min(-10 * float(np.log10(max(error, 1e-12))), _MAX_PSNR)
