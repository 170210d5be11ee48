"""A 3D Gaussian Splatting map in memory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gsfeatloc_ros.maps.similarity import Similarity

# Numbers of spherical-harmonics coefficients per colour channel for degrees 0 to 3; those of higher ones are not read.
SH_COEFFICIENTS = (1, 4, 9, 16)


class MapError(ValueError):
    """A map file cannot be used; the message names the file, what is wrong and what to do."""


# Gaussians that cover more than this are what is there; others may be haze.
SOLID_OPACITY = 0.5


@dataclass(frozen=True)
class Reading:
    """What there is to say of how a map's file was read.

    Attributes:
        notes: whole sentences: what was left out, assumed, or is in the file and not used.
        left_out: number of rows of the file that hold no Gaussian.
        other: how else the file may be meant, and what to set then, for photos that have nothing in common with the
            map; empty where there is no doubt.
    """

    notes: tuple[str, ...] = ()
    left_out: int = 0
    other: str = ""


@dataclass(frozen=True, eq=False)
class GaussianMap:
    """Gaussians with their parameters activated, ready to be drawn.

    Attributes:
        means: (N, 3) float32 centres, splat frame.
        scales: (N, 3) float32 standard deviations along the axes, > 0, splat units.
        rotations: (N, 4) float32 unit quaternions wxyz that turn the Gaussian's axes into the splat frame's.
        opacities: (N,) float32 in [0, 1].
        sh: (N, C, 3) float32 spherical harmonics of the colour, C = 1, 4, 9 or 16 for degree 0 to 3, in the order of
            the INRIA rasterizer; colour = 0.5 + the harmonics' sum in the direction from the camera, cut at 0.
        antialiased: trained with the filter of Mip-Splatting: a Gaussian that the 2D blur widens is dimmed as much.
        S_map_splat: where the frame that the Gaussians were trained in lies in the robot's map frame. Renderers move
            the camera by it, for spherical harmonics do not turn for free.
        reading: what there is to say of how its file was read.
    """

    means: np.ndarray
    scales: np.ndarray
    rotations: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    antialiased: bool = False
    S_map_splat: Similarity = field(default_factory=Similarity)
    reading: Reading = field(default_factory=Reading)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def highest_opacity(self) -> float:
        """Opacity of the most opaque Gaussian; 0 without any."""
        return float(self.opacities.max(initial=0.0))

    def placed(self, S_map_file: Similarity) -> GaussianMap:
        """Return the same where the frame of its file lies elsewhere in the robot's map frame."""
        return replace(self, S_map_splat=S_map_file @ self.S_map_splat)

    def solid_points(self, count: int) -> np.ndarray:
        """Return the centres (n, 3) float32, splat frame, of up to `count` Gaussians that cover more than a half."""
        return sample_solid(self.means, self.opacities, count)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return SH_COEFFICIENTS.index(self.sh.shape[1])


def sample_solid(means: np.ndarray, opacities: np.ndarray, count: int) -> np.ndarray:
    """Return up to `count` of the centres `means` (N, 3) of Gaussians whose `opacities` (N,) are more than a half."""
    solid = means[opacities > SOLID_OPACITY]
    return solid[:: -(-len(solid) // count) or 1]
