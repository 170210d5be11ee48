"""The inspection of a map: all that is found out about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.index.placement import radius
from gsfeatloc_ros.inspect.findings import find_problems
from gsfeatloc_ros.inspect.floaters import Floaters, find_floaters
from gsfeatloc_ros.inspect.frame import upright_parameters
from gsfeatloc_ros.inspect.looks import choose, look_around
from gsfeatloc_ros.inspect.photos import PhotoFit, fit_photos
from gsfeatloc_ros.inspect.quality import Quality, look_closely
from gsfeatloc_ros.inspect.source import Source, read_source
from gsfeatloc_ros.inspect.statistics import Statistics, describe_gaussians
from gsfeatloc_ros.inspect.surfaces import find_surfaces
from gsfeatloc_ros.inspect.unit import Unit, find_unit
from gsfeatloc_ros.inspect.upright import Upright, find_upright
from gsfeatloc_ros.localize.settings import MapSettings, RendererSettings
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.render import create_renderer

# Poses that are looked from; a third of them is in free space.
_LOOKS = 400
# Views of the contact sheet.
_VIEWS = 12
# Of photos, in pixels, unless another is asked for.
MAX_WIDTH = 1600


@dataclass(frozen=True, eq=False)
class Inspection:
    """What is found out about a map.

    Attributes:
        source, statistics, quality, floaters: of its file, its Gaussians, its views.
        upright, unit: None where nothing tells.
        parameters: of the node, that would set it upright with the floor at z = 0; empty where that is not sure.
        fit: to photos; None where there are none.
        notes: how the file was read.
        problems: what looks wrong.
        views: (240, 320, 3) uint8 RGB each, the contact sheet.
    """

    source: Source
    statistics: Statistics
    quality: Quality
    floaters: Floaters
    upright: Upright | None
    unit: Unit | None
    parameters: dict[str, list[float]]
    fit: PhotoFit | None
    notes: list[str]
    problems: list[str]
    views: list[np.ndarray]

    def as_json(self) -> dict[str, Any]:
        """Return all but the views, for a JSON file."""
        content = {name: value for name, value in asdict(self).items() if name != "views"}
        if self.fit is not None:
            for stored, comparison in zip(content["fit"]["comparisons"], self.fit.comparisons, strict=True):
                stored["better"] = comparison.better
        return content


def inspect_map(
    map_: MapSettings,
    renderer_settings: RendererSettings,
    scene: Scene | None = None,
    max_width: int = MAX_WIDTH,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Inspection:
    """Look at a map from all sides.

    Args:
        map_: the map, and where it lies.
        renderer_settings: how it is drawn.
        scene: photos of it, with poses in the frame of its file.
        max_width: to which wider photos are resized (inspect/photos.py).
        progress: called with the number of places looked from, and of all.

    Raises:
        ValueError, OSError, RuntimeError: the map, or a photo, cannot be used.
    """
    alignment = map_.alignment()
    gaussian_map = load_map(map_.path, alignment, map_.reading)
    renderer = create_renderer(gaussian_map, renderer_settings.device, renderer_settings.threads)
    source = read_source(Path(map_.path))
    looks = look_around(renderer, _LOOKS, progress=progress)
    quality, views = look_closely(renderer, choose(looks, _VIEWS))
    floaters = find_floaters(gaussian_map, looks, renderer_settings)
    upright = find_upright(find_surfaces(looks, radius(renderer.solid_points)))
    statistics = describe_gaussians(gaussian_map)
    unit = None
    if upright is not None and upright.sure:
        height = None
        if scene is not None:
            centres = alignment.transform(scene.trajectory[:, :3, 3])
            height = float(np.median(centres @ np.array(upright.up)))
        unit = find_unit(upright.floor, upright.ceiling, height)
    is_spz = source.format.startswith(".spz")
    return Inspection(
        source=source,
        statistics=statistics,
        quality=quality,
        floaters=floaters,
        upright=upright,
        unit=unit,
        parameters=upright_parameters(upright, alignment) if upright is not None and upright.sure else {},
        fit=None if scene is None else fit_photos(scene, map_, renderer_settings, is_spz, max_width),
        notes=list(gaussian_map.reading.notes),
        problems=find_problems(statistics, quality, floaters, upright, unit),
        views=views,
    )
