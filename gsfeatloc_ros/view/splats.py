"""The Gaussians of a map as a browser draws them: thinned, in colours that do not change with the direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gsfeatloc_ros.maps.cloud import seen_colours
from gsfeatloc_ros.maps.gaussian_map import GaussianMap


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians about an origin, in a unit in which they are about 1 apart from it.

    Browsers take centres of 32 bits and covariances of 16: those of a map far from its origin, or of a small unit,
    would be lost.

    Attributes:
        centres: (n, 3) float32.
        covariances: (n, 3, 3) float32.
        colours: (n, 3) uint8 RGB.
        opacities: (n, 1) float32 in [0, 1].
        origin: (3,) of them in the map frame.
        unit: of them in map units.
    """

    centres: np.ndarray
    covariances: np.ndarray
    colours: np.ndarray
    opacities: np.ndarray
    origin: np.ndarray
    unit: float


def thinned_splats(gaussian_map: GaussianMap, count: int) -> Splats:
    """Return up to `count` of a map's Gaussians, chosen by chance, and larger so that they cover as much as all did."""
    rows = np.random.default_rng(0).permutation(len(gaussian_map))[:count]
    larger = np.sqrt(len(gaussian_map) / len(rows))
    S_map_splat = gaussian_map.S_map_splat
    centres = S_map_splat.transform(gaussian_map.means[rows].astype(np.float64))
    origin = np.median(centres, axis=0)
    unit = float(np.median(np.abs(centres - origin))) or 1.0
    turns = Rotation.from_quat(gaussian_map.rotations[rows][:, [1, 2, 3, 0]]).as_matrix()
    axes = S_map_splat.rotation @ turns * (gaussian_map.scales[rows, None, :] * larger * S_map_splat.scale / unit)
    return Splats(
        centres=((centres - origin) / unit).astype(np.float32),
        covariances=(axes @ axes.transpose(0, 2, 1)).astype(np.float32),
        colours=seen_colours(gaussian_map, rows),
        opacities=gaussian_map.opacities[rows, None].astype(np.float32),
        origin=origin,
        unit=unit,
    )
