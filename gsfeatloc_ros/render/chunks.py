"""A map as kernels take it: chunks of Gaussians side by side, and the coarser levels of a large map."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, Reading, sample_solid
from gsfeatloc_ros.maps.similarity import Similarity

if TYPE_CHECKING:
    from gsfeatloc_ros.render.stored import StoredArray

# Held while kernels run in parallel: numba's fallback threading layer does not take calls from two threads at once.
KERNEL_LOCK = threading.Lock()

CHUNK = 256
# Rows of a chunk: centre, covariance in the splat frame, log2 of the opacity.
(MEAN_X, MEAN_Y, MEAN_Z, COV_XX, COV_XY, COV_XZ, COV_YY, COV_YZ, COV_ZZ, LOG2_OPACITY) = range(10)
ROWS = 10
# A map of more Gaussians than this gets coarser levels, and stays on disk; one of as many is drawn exactly.
LARGE_MAP = 1 << 20
# A view of such a map is drawn from no more chunks: memory has this bound.
MAX_CHUNKS = LARGE_MAP // CHUNK
# Most that a merged Gaussian is opaque: where there are more layers of them, more is not seen.
MAX_LOG2_OPACITY = 2.0
# Chunks of a level, neighbours, that one of the next coarser level stands for.
BRANCHING = 4


def level_starts(leaves: int, coarser: bool) -> np.ndarray:
    """Return where in a map's chunks each level starts, and where the last ends, (levels + 1,) int64.

    Args:
        leaves: chunks of the finest level.
        coarser: whether there are others: the next has a chunk for each BRANCHING, up to the level of one chunk.
    """
    sizes = [leaves]
    while coarser and sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // BRANCHING))
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


@dataclass(frozen=True, eq=False)
class PreparedMap:
    """The Gaussians of a map that can be seen, sorted by size and along a Morton curve, cut into chunks of CHUNK.

    A chunk keeps its Gaussians side by side, so that one instruction treats many of them. The last chunk is filled up
    with Gaussians of opacity 0. Behind these `leaves` of a large map are its coarser levels, whose Gaussians each stand
    for some of the level before (render/levels.py).

    Attributes:
        gaussians: (chunks, ROWS, CHUNK) float32, splat frame; merged ones may be more than opaque. Of a large map they,
            and `sh`, may stay in a file.
        sh: (chunks, 3 C, CHUNK) float16, row 3 k + channel is harmonic k; half precision costs less than the rounding
            to 8-bit colours by far, and halves what a map takes.
        low, high: (chunks, 3) float32, splat frame, the box outside which no Gaussian of the chunk, nor one that it
            stands for, has an alpha of MIN_ALPHA.
        sizes: (chunks,) float32, how large the merged Gaussians of the chunk are, one standard deviation, splat units;
            0 in the leaves.
        leaves: number of chunks of the finest level.
        antialiased, S_map_splat, reading: as in GaussianMap.
    """

    gaussians: np.ndarray | StoredArray
    sh: np.ndarray | StoredArray
    low: np.ndarray
    high: np.ndarray
    sizes: np.ndarray
    leaves: int
    antialiased: bool = False
    S_map_splat: Similarity = field(default_factory=Similarity)
    reading: Reading = field(default_factory=Reading)

    def placed(self, S_map_file: Similarity) -> PreparedMap:
        """Return the same where the frame of its file lies elsewhere in the robot's map frame."""
        return replace(self, S_map_splat=S_map_file @ self.S_map_splat)

    @property
    def sh_coefficients(self) -> int:
        """Number of spherical harmonics per colour channel that are stored."""
        return self.sh.shape[1] // 3

    @property
    def level_starts(self) -> np.ndarray:
        """Where in the chunks each level starts, the finest first, and where the last ends, (levels + 1,) int64."""
        return level_starts(self.leaves, self.leaves < len(self.sizes))

    def solid_points(self, count: int) -> np.ndarray:
        """Return the centres (n, 3) float32, splat frame, of up to `count` Gaussians that cover more than a half.

        Of a large map they are those of the finest level that is small enough to be looked at as a whole.
        """
        starts = self.level_starts
        level = next((n for n, size in enumerate(np.diff(starts)) if size * CHUNK <= LARGE_MAP), 0)
        chunks = self.gaussians[starts[level] : starts[level + 1]]
        means = chunks[:, MEAN_X : MEAN_Z + 1].transpose(0, 2, 1).reshape(-1, 3)
        return sample_solid(means, np.exp2(chunks[:, LOG2_OPACITY].ravel()), count)

    def unpacked(self, sh_degree: int) -> UnpackedGaussians:
        """Return the Gaussians one by one, in their order, with harmonics up to a degree or as many as there are."""
        used = min(self.sh_coefficients, SH_COEFFICIENTS[sh_degree])
        rows = self.gaussians[: self.leaves].transpose(0, 2, 1).reshape(-1, ROWS)
        # Those that fill up the last chunk have no opacity.
        count = np.count_nonzero(np.isfinite(rows[:, LOG2_OPACITY]))
        sh = self.sh[: self.leaves][:, : 3 * used].transpose(0, 2, 1).reshape(-1, used, 3)
        return UnpackedGaussians(
            means=np.ascontiguousarray(rows[:count, MEAN_X : MEAN_Z + 1]),
            covariances=np.ascontiguousarray(rows[:count, COV_XX : COV_ZZ + 1]),
            opacities=np.exp2(rows[:count, LOG2_OPACITY]),
            sh=sh[:count],
        )


@dataclass(frozen=True, eq=False)
class UnpackedGaussians:
    """The Gaussians of a prepared map one by one.

    Attributes:
        means: (N, 3) float32, splat frame.
        covariances: (N, 6) float32, splat frame: xx, xy, xz, yy, yz, zz.
        opacities: (N,) float32.
        sh: (N, C, 3) float16, harmonics of the colour.
    """

    means: np.ndarray
    covariances: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
