"""Settings of what a localizer is made of, by the groups of the node's parameters: map, matcher, renderer."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gsfeatloc_ros.common.device import DEVICES
from gsfeatloc_ros.common.geometry import matrix_from_quaternion, quaternion_from_matrix
from gsfeatloc_ros.common.parameter import Value, parameter, parameters_of, settings_from, values_of
from gsfeatloc_ros.maps import MapError, ReadOptions, Similarity, read_dataparser_transforms
from gsfeatloc_ros.maps.bundle import MANIFEST, read_bundle
from gsfeatloc_ros.match import DEFAULT_MATCHER, DEFAULT_MAX_FEATURES, MATCHERS


@dataclass(frozen=True)
class MapSettings:
    """Which map, and where it lies."""

    path: str = parameter(
        "",
        "Path of the map (required): "
        "a .ply, compressed .ply, .splat, .spz or .sog, or the folder of an unbundled or streamed .sog, of gsplat's "
        "PNG images or of the INRIA trainer's output; or a map bundle, made by gsfeatloc prepare.",
        live=True,
    )
    frame_id: str = parameter("map", "Name of the map's frame, in which answers are given.")
    aligned: bool = parameter(False, "Whether that is the robot's map frame (metres, z up): publish_tf needs it.")
    scale: float = parameter(1.0, "Units of the map frame in one unit of the file.", (1e-6, 1e6))
    translation: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0), "Where the file's origin lies in the map frame: x, y, z."
    )
    rotation: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0, 1.0), "Quaternion x, y, z, w that turns the file's axes into the map frame's."
    )
    dataparser_transforms: str = parameter(
        "", "Path of nerfstudio's dataparser_transforms.json, undone before the three above; empty for none."
    )
    reading: ReadOptions = field(default_factory=ReadOptions)
    cloud_points: int = parameter(
        100_000, "Most points of ~/map, the Gaussians of most opacity times size; 0 for no such topic.", (0, 5_000_000)
    )
    occupancy_resolution: float = parameter(0.05, "Map units of a cell of ~/occupancy.", (1e-3, 10.0))
    occupancy_min_height: float = parameter(
        0.1, "Height above z = 0 in map units from which ~/occupancy holds what is in a robot's way.", (-100.0, 100.0)
    )
    occupancy_max_height: float = parameter(1.0, "Height up to which it does.", (-100.0, 100.0))
    cache: bool = parameter(
        True, "Keep the map, prepared for rendering, in a file beside it (*.gsfeatloc-cache): later starts are faster."
    )

    def alignment(self) -> Similarity:
        """Return where the frame of the map's file lies in the robot's map frame.

        Raises:
            ValueError: a parameter is no translation, no quaternion or no file of nerfstudio's; the message says which.
        """
        translation = _numbers("map.translation", self.translation, 3)
        try:
            rotation = matrix_from_quaternion(_numbers("map.rotation", self.rotation, 4))
        except ValueError as error:
            raise ValueError(f"parameter map.rotation: {error}") from error
        alignment = Similarity(self.scale, rotation, translation)
        if not self.dataparser_transforms:
            return alignment
        return alignment @ read_dataparser_transforms(self.dataparser_transforms)

    def resolved(self) -> MapSettings:
        """Return the same with what a map bundle says where nothing else was given; of another map, itself.

        Raises:
            MapError: the bundle cannot be used, or says other than what was given; the message says what.
        """
        bundle = read_bundle(self.path) if self.path else None
        if bundle is None:
            return self
        bundle.check_alignment()
        given, default = values_of(self, "map."), values_of(MapSettings(), "map.")
        known = {item.name: item for item in parameters_of(MapSettings, "map.") if item.name not in _NOT_BUNDLED}
        for name, value in bundle.parameters.items():
            if name not in known:
                raise MapError(f"{self.path}/{MANIFEST}: has a parameter that no bundle has: {name!r}")
            try:
                says = known[name].converted(value)
            except ValueError as error:
                raise MapError(f"{self.path}/{MANIFEST}: {error}") from error
            if given[name] not in (default[name], says):
                raise MapError(
                    f"parameter {name}: {given[name]} was given, and the bundle {self.path} says {says}: leave it out, "
                    "or make the bundle anew"
                )
            given[name] = says
        if bundle.parameters.keys() & PLACE and self.dataparser_transforms:
            raise MapError(
                f"parameter map.dataparser_transforms: {self.dataparser_transforms} was given, and the bundle "
                f"{self.path} has its alignment: leave it out, or make the bundle anew"
            )
        return settings_from(MapSettings, given, "map.")

    def bundled(self) -> dict[str, Value]:
        """Return the parameters that a bundle of this map says: what nerfstudio's file says is part of the alignment.

        Raises:
            ValueError: the map lies nowhere; the message says why.
        """
        placed = self
        if self.dataparser_transforms:
            alignment = self.alignment()
            rotation = tuple(quaternion_from_matrix(alignment.rotation).tolist())
            translation = tuple(alignment.translation.tolist())
            placed = replace(self, scale=alignment.scale, rotation=rotation, translation=translation)
        default, values = values_of(MapSettings(), "map."), values_of(placed, "map.")
        said = {name for name, value in values.items() if value != default[name] and name not in _NOT_BUNDLED}
        if said & set(PLACE):
            said |= set(PLACE)
        return {name: value for name, value in values.items() if name in said}


# Where a map lies: a bundle says all of these or none.
PLACE = ("map.aligned", "map.scale", "map.translation", "map.rotation")
_NOT_BUNDLED = ("map.path", "map.dataparser_transforms", "map.cache")


@dataclass(frozen=True)
class MatcherSettings:
    """Which features."""

    name: str = parameter(DEFAULT_MATCHER, f"Feature matcher: {', '.join(MATCHERS)}.", choices=tuple(MATCHERS))
    weights: str = parameter(
        "", "Path of a learned matcher's weights (two networks: of their folder); empty looks in the usual places."
    )
    max_features: int = parameter(DEFAULT_MAX_FEATURES, "Most features taken from an image.", (64, 32768))


@dataclass(frozen=True)
class CpuSettings:
    """What is taken of the CPU."""

    threads: int = parameter(
        0,
        "Threads that compute at most: of numba, OpenMP (torch, faiss) and OpenCV; 0 takes all cores.",
        (0, 1024),
    )


@dataclass(frozen=True)
class RendererSettings:
    """What draws the map, and how."""

    device: str = parameter("auto", "Where to render, match and track: cpu, cuda, or auto to choose.", choices=DEVICES)
    # Of the CPU renderer alone, for tools that measure; 0 takes as many as the process may have.
    threads: int = 0
    sh_degree: int = parameter(3, "Highest degree of the spherical harmonics of the colours drawn.", (0, 3))
    resolution_scale: float = parameter(1.0, "Draw so many times the width and height, and enlarge that.", (0.1, 1.0))


def _numbers(name: str, values: tuple[float, ...], count: int) -> np.ndarray:
    numbers = np.array(values, dtype=np.float64)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"parameter {name}: {numbers.tolist()} is not {count} finite numbers")
    return numbers
