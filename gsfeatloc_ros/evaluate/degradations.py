"""Degradations of maps: what training, pruning and time make of them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from gsfeatloc_ros.common.geometry import random_unit_vector
from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.evaluate.protocol import trajectory_radius
from gsfeatloc_ros.maps import GaussianMap

Degradation: TypeAlias = Callable[[GaussianMap, Scene, np.random.Generator], GaussianMap]
"""Makes of the map of a scene a worse one."""

_DROPPED_SHARE = 0.3
_GROWTH = 1.3
_FLOATERS = 3000
# Where floaters and haze hang, in radii of the trajectory before the cameras.
_DISTANCES = (0.1, 0.5)
_HAZE_BALLS = 110
_HAZE_SIZES = (0.1, 0.3)  # standard deviations, over the distance
_HAZE_OPACITIES = (0.2, 0.5)
_HAZE_LEVELS = (0.4, 0.7)  # grey
# Bends are sums of so many waves as long as the trajectory is wide, twice its radius, that turn the map's points.
_BEND_WAVES = 4
# Of the colour's constant spherical harmonic.
_SH_0 = 0.28209479177387814


def degrade(name: str, map_: GaussianMap, scene: Scene, seed: int) -> GaussianMap:
    """Do one of DEGRADATIONS to the map of a scene: the same for the same name and seed."""
    return DEGRADATIONS[name](map_, scene, np.random.default_rng([seed, zlib.crc32(name.encode())]))


def _drop(map_: GaussianMap, scene: Scene, rng: np.random.Generator) -> GaussianMap:
    return _select(map_, rng.random(len(map_)) >= _DROPPED_SHARE)


def _grow(map_: GaussianMap, scene: Scene, rng: np.random.Generator) -> GaussianMap:
    return replace(map_, scales=_GROWTH * map_.scales)


def _float(map_: GaussianMap, scene: Scene, rng: np.random.Generator) -> GaussianMap:
    """Hang Gaussians of the map's own shapes and opacities, in random colours, before the cameras.

    They are made smaller in proportion to their distance, so that they look as large as what they hang before.
    """
    like = _select(map_, rng.integers(len(map_), size=_FLOATERS))
    means, distances = _before_cameras(map_, scene, _FLOATERS, rng)
    colours = _colours(map_, rng.random((_FLOATERS, 3)))
    return _joined(map_, replace(like, means=means, scales=like.scales * distances[:, None], sh=colours))


def _haze(map_: GaussianMap, scene: Scene, rng: np.random.Generator) -> GaussianMap:
    """Hang large translucent grey balls before the cameras."""
    means, distances = _before_cameras(map_, scene, _HAZE_BALLS, rng)
    radii = trajectory_radius(scene) / map_.S_map_splat.scale * distances * rng.uniform(*_HAZE_SIZES, _HAZE_BALLS)
    haze = replace(
        map_,
        means=means,
        scales=np.repeat(radii[:, None], 3, axis=1).astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (_HAZE_BALLS, 1)),
        opacities=rng.uniform(*_HAZE_OPACITIES, _HAZE_BALLS).astype(np.float32),
        sh=_colours(map_, np.repeat(rng.uniform(*_HAZE_LEVELS, (_HAZE_BALLS, 1)), 3, axis=1)),
    )
    return _joined(map_, haze)


def _bend(percent: float) -> Degradation:
    """Move the map's points by a smooth field with an RMS of `percent` of the trajectory's width."""

    def bend(map_: GaussianMap, scene: Scene, rng: np.random.Generator) -> GaussianMap:
        width = 2 * trajectory_radius(scene) / map_.S_map_splat.scale
        shift = np.zeros(map_.means.shape)
        for _ in range(_BEND_WAVES):
            wave, direction, phase = random_unit_vector(rng), random_unit_vector(rng), rng.uniform(0, 2 * np.pi)
            shift += np.sin(2 * np.pi / width * map_.means @ wave + phase)[:, None] * direction
        # A sine has a mean square of a half.
        amplitude = percent / 100 * width / np.sqrt(_BEND_WAVES / 2)
        return replace(map_, means=(map_.means + amplitude * shift).astype(np.float32))

    return bend


def _flatten(map_: GaussianMap, scene: Scene, rng: np.random.Generator) -> GaussianMap:
    """Leave the colours that do not depend on the direction."""
    return replace(map_, sh=map_.sh[:, :1])


DEGRADATIONS: dict[str, Degradation] = {
    "dropped": _drop,
    "grown": _grow,
    "floaters": _float,
    "haze": _haze,
    "bent-0.5": _bend(0.5),
    "sh0": _flatten,
}
"""By name."""


def _before_cameras(
    map_: GaussianMap, scene: Scene, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points (count, 3), float32 in the splat frame, close before random frames of the scene and in view there.

    The second array has their distances (count,) float32 in radii of the trajectory.
    """
    poses = scene.trajectory[rng.integers(len(scene.trajectory), size=count)]
    camera = scene.camera.pinhole()
    pixels = rng.random((count, 2)) * [camera.width, camera.height] - 0.5
    distances = rng.uniform(*_DISTANCES, count)
    rays = camera.rays(pixels) * trajectory_radius(scene) * distances[:, None]
    points = np.einsum("nij,nj->ni", poses[:, :3, :3], rays) + poses[:, :3, 3]
    return map_.S_map_splat.inverse().transform(points).astype(np.float32), distances.astype(np.float32)


def _colours(map_: GaussianMap, rgb: np.ndarray) -> np.ndarray:
    """Return the spherical harmonics (N, C, 3) float32, as many as the map has, of colours (N, 3) in [0, 1]."""
    sh = np.zeros((len(rgb), *map_.sh.shape[1:]), np.float32)
    sh[:, 0] = (rgb - 0.5) / _SH_0
    return sh


def _select(map_: GaussianMap, kept: np.ndarray) -> GaussianMap:
    """Return the Gaussians that a mask or indices name."""
    return replace(
        map_,
        means=map_.means[kept],
        scales=map_.scales[kept],
        rotations=map_.rotations[kept],
        opacities=map_.opacities[kept],
        sh=map_.sh[kept],
    )


def _joined(map_: GaussianMap, other: GaussianMap) -> GaussianMap:
    """Return the Gaussians of both."""
    return replace(
        map_,
        means=np.concatenate([map_.means, other.means]),
        scales=np.concatenate([map_.scales, other.scales]),
        rotations=np.concatenate([map_.rotations, other.rotations]),
        opacities=np.concatenate([map_.opacities, other.opacities]),
        sh=np.concatenate([map_.sh, other.sh]),
    )
