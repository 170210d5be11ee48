"""From what files hold to a map: block by block, so that no second copy of the map is ever in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from gsfeatloc_ros.common.memory import available_memory
from gsfeatloc_ros.common.safe_files import open_regular
from gsfeatloc_ros.maps.gaussian_map import GaussianMap, MapError, Reading
from gsfeatloc_ros.maps.options import ReadOptions
from gsfeatloc_ros.maps.similarity import Similarity

# Constant harmonic of the sphere: colour = 0.5 + SH_C0 * its coefficient.
SH_C0 = 0.28209479177387814
# Gaussians taken apart at once: a block of them stays in the CPU's cache. A multiple of compressed .ply's chunk.
MAX_BLOCK_ROWS = 4096
# Gaussians that are looked at together where a map is never whole in memory.
MAX_PART_ROWS = 8 * MAX_BLOCK_ROWS
# Of SH degree 3 these take 11.8 GB.
MAX_GAUSSIANS = 50_000_000
# An .spz of SH degree 3 takes no more for each.
MAX_PACKED_BYTES = 65 * MAX_GAUSSIANS
# Packed Gaussians compress to a half or a third, those that are all alike further. What claims to unpack to more is no
# map, unless it is so small that it does no harm.
MAX_COMPRESSION_RATIO = 20
_HARMLESS_BYTES = 1 << 18
# Of the memory that is left, what a map may take: the rest is for the map in use, if there is one, and its renders.
_MEMORY_SHARE = 0.8
# What a Gaussian takes: in float32 here, as render/prepare.py prepares it, and its place in the order of drawing.
_LOADED_BYTES, _COEFFICIENT_BYTES = 44 + 40 + 12, 12 + 6

_ARRAYS = ("means", "scales", "rotations", "opacities", "sh")
# With a larger share of rows that hold no Gaussian, a file is damaged or not what it seems.
_MAX_INVALID_SHARE = 0.01
# Farther from the origin than this (splat units), float32 renders would shake: its steps are 6e-5 there.
_MAX_DISTANCE = 1000.0
# Positions known no better than to this many splat units are worth a word.
_COARSE_STEP = 1e-3


@dataclass(frozen=True)
class Layout:
    """What the header of a file says.

    Attributes:
        count: number of Gaussians.
        sh_coefficients: number of spherical harmonics per colour channel that are read.
        antialiased: as in GaussianMap; None where the file says nothing of it.
        notes, other: as in Reading.
    """

    count: int
    sh_coefficients: int
    antialiased: bool | None = None
    notes: tuple[str, ...] = ()
    other: str = ""


class Block(NamedTuple):
    """A run of a map's Gaussians, as in GaussianMap but unchecked: quaternions of any norm, any values.

    `step` (n,) is how finely the file tells positions, where single precision limits that; 0 elsewhere.
    """

    means: np.ndarray  # (n, 3), float64 where the file's are
    scales: np.ndarray  # (n, 3)
    rotations: np.ndarray  # (n, 4) wxyz
    opacities: np.ndarray  # (n,)
    sh: np.ndarray  # (n, C, 3)
    step: np.ndarray | float = 0.0


T = TypeVar("T")
# What is made of a map's path, layout and blocks: by `assemble` a GaussianMap.
Gather = Callable[[Path, Layout, Iterable[Block], ReadOptions], T]


def check_count(path: Path, count: int) -> None:
    """Refuse a map of no Gaussians or of more than MAX_GAUSSIANS, before memory is taken for them."""
    if count == 0:
        raise MapError(f"{path}: holds no Gaussians")
    if count > MAX_GAUSSIANS:
        raise MapError(f"{path}: claims {count} Gaussians; at most {MAX_GAUSSIANS} are read: crop or thin the map")


def check_compression(path: Path, packed_size: int, file_size: int) -> None:
    """Refuse a claim of `packed_size` bytes compressed into a file of `file_size`, before memory is taken for them."""
    if packed_size > max(MAX_COMPRESSION_RATIO * file_size, _HARMLESS_BYTES):
        raise MapError(f"{path}: is damaged: it claims {packed_size} bytes of Gaussians compressed to {file_size}")
    check_memory(path, packed_size)


def check_memory(path: Path, size: int) -> None:
    """Refuse a map that takes `size` bytes where these are not to spare: it must not cost the one that is in use."""
    available = available_memory()
    if size > _MEMORY_SHARE * available:
        raise MapError(
            f"{path}: takes {1e-9 * size:.1f} GB of memory to load, and {1e-9 * available:.1f} GB are available: crop "
            "or thin the map, or give this process more"
        )


def read_packed(path: Path, file: Path, limit: int = MAX_PACKED_BYTES) -> bytes:
    """Return the contents of one of the files of the map at `path`; refuse more than `limit` bytes."""
    size = file.stat().st_size
    if size > limit:
        raise MapError(f"{path}: {file.name} of {size} bytes is too large; at most {limit} are read")
    check_memory(path, size)
    with open_regular(file) as stream:
        return stream.read(size)


def block_slices(count: int) -> Iterator[slice]:
    """Yield slices of at most MAX_BLOCK_ROWS rows that cover `count` rows."""
    for start in range(0, count, MAX_BLOCK_ROWS):
        yield slice(start, min(start + MAX_BLOCK_ROWS, count))


def single_precision_step(means: np.ndarray) -> np.ndarray:
    """Return how far apart (n,) the numbers of the type of the positions (n, 3) are there, along the coarsest axis."""
    return np.spacing(np.abs(means).max(axis=1))


def assemble(path: Path, layout: Layout, blocks: Iterable[Block], options: ReadOptions) -> GaussianMap:
    """Gather `blocks`, which together hold as many Gaussians as the layout says, into a map.

    Rows with values that are not finite in float32, and with quaternions of zero length, are left out. Of a map far
    from its file's origin, as georeferenced ones are, an offset is taken off before its positions become float32; it is
    in S_map_splat.

    Raises:
        MapError: more than 1 % of the rows would be left out, positions are coarser than the Gaussians, or there is too
            little memory.
    """
    check_memory(path, layout.count * (_LOADED_BYTES + _COEFFICIENT_BYTES * layout.sh_coefficients))
    gaussian_map = empty_map(layout.count, layout.sh_coefficients)
    intake, kept = Intake(path, layout, options), 0
    for block in blocks:
        kept += intake.take(block, gaussian_map, kept)
    if kept < layout.count:
        gaussian_map = replace(gaussian_map, **{name: getattr(gaussian_map, name)[:kept] for name in _ARRAYS})
    return intake.described(gaussian_map)


def empty_map(count: int, sh_coefficients: int) -> GaussianMap:
    """Return a map with room for `count` Gaussians."""
    return GaussianMap(
        means=np.empty((count, 3), np.float32),
        scales=np.empty((count, 3), np.float32),
        rotations=np.empty((count, 4), np.float32),
        opacities=np.empty(count, np.float32),
        sh=np.empty((count, sh_coefficients, 3), np.float32),
    )


def parts(path: Path, layout: Layout, blocks: Iterable[Block], options: ReadOptions) -> Iterator[GaussianMap]:
    """Yield a map in parts of at most MAX_PART_ROWS Gaussians; what is in one is gone when the next is asked for.

    Raises:
        MapError: as `assemble` does, when all parts were there.
    """
    intake, room, kept = Intake(path, layout, options), empty_map(MAX_PART_ROWS, layout.sh_coefficients), 0

    def part() -> GaussianMap:
        filled = {name: getattr(room, name)[:kept] for name in _ARRAYS}
        return replace(room, **filled, S_map_splat=intake.S_map_splat)

    for block in blocks:
        if kept + len(block.means) > MAX_PART_ROWS:
            yield part()
            kept = 0
        kept += intake.take(block, room, kept)
    yield part()
    intake.described(room)


class Intake:
    """Takes the blocks of a map one after another: leaves out what holds no Gaussian, and notes what there is to say.

    Args:
        path, layout, options: as for `assemble`.
    """

    def __init__(self, path: Path, layout: Layout, options: ReadOptions) -> None:
        self._path, self._layout = path, layout
        self._antialiased, self._notes = _antialiased(layout, options)
        self._offset: np.ndarray | None = None
        self._read = self._kept = self._first_invalid = 0
        self._steps = _Steps()

    def take(self, block: Block, gaussian_map: GaussianMap, start: int) -> int:
        """Put the Gaussians of a block into a map's arrays, from row `start` on; return how many."""
        if self._offset is None:
            self._offset = _offset(block.means)
        valid = _store(gaussian_map, start, block, self._offset)
        if self._kept == self._read and not valid.all():
            self._first_invalid = self._read + int(valid.argmin())
        stored = int(np.count_nonzero(valid))
        self._steps.take(block, gaussian_map.scales[start : start + stored], valid)
        self._read, self._kept = self._read + len(valid), self._kept + stored
        return stored

    @property
    def S_map_splat(self) -> Similarity:
        """Where the splat frame lies in the file's, as soon as a block was taken."""
        return Similarity(translation=np.zeros(3) if self._offset is None else self._offset)

    def described(self, gaussian_map: GaussianMap) -> GaussianMap:
        """Return a map with what is known of all blocks: where it lies, how it is drawn, what there is to say.

        Raises:
            MapError: too many rows hold no Gaussian, or positions are too coarse.
        """
        invalid = self._read - self._kept
        notes = [*self._layout.notes, *self._notes, *self._steps.notes(self._kept)]
        if invalid:
            what = (
                f"{invalid} of {self._layout.count} Gaussians have values that are NaN, infinite or too large, or a "
                f"rotation quaternion of zero length, the first is number {self._first_invalid}"
            )
            if invalid > _MAX_INVALID_SHARE * self._layout.count:
                raise MapError(f"{self._path}: {what}; up to {_MAX_INVALID_SHARE:.0%} of such would be left out")
            notes.append(f"{what}: left out")
        self._steps.check(self._path, self._kept)
        return replace(
            gaussian_map,
            antialiased=self._antialiased,
            S_map_splat=self.S_map_splat,
            reading=Reading(tuple(notes), invalid, self._layout.other),
        )


def _antialiased(layout: Layout, options: ReadOptions) -> tuple[bool, list[str]]:
    """Return whether to draw antialiased, and what there is to say of that."""
    if options.antialiased == "auto":
        if layout.antialiased is None:
            return False, ["whether it was trained antialiased the file does not say: drawn as not (map.antialiased)"]
        return layout.antialiased, []
    chosen = options.antialiased == "true"
    if layout.antialiased not in (None, chosen):
        return chosen, [f"map.antialiased is {options.antialiased}, though the file says otherwise"]
    return chosen, []


def _offset(means: np.ndarray) -> np.ndarray:
    """Return whole numbers (3,) float64 to take off all positions, by some (n, 3) of them; zeros near the origin."""
    finite = means[np.isfinite(means).all(axis=1)].astype(np.float64)
    if not len(finite):
        return np.zeros(3)
    offset = np.round(np.median(finite, axis=0))
    return offset if np.abs(offset).max() > _MAX_DISTANCE else np.zeros(3)


def _store(gaussian_map: GaussianMap, start: int, block: Block, offset: np.ndarray) -> np.ndarray:
    """Put the valid Gaussians of a block into a map's arrays from row `start` on; return which (n,) bool are valid."""
    rows = slice(start, start + len(block.means))
    valid = np.ones(len(block.means), dtype=bool)
    placed = block._replace(means=block.means - offset) if offset.any() else block
    for name in _ARRAYS:
        stored = getattr(gaussian_map, name)[rows]
        stored[...] = getattr(placed, name)
        valid &= np.isfinite(stored).all(axis=tuple(range(1, stored.ndim)))
    # A Gaussian may be flatter than float32 can say, never of no extent.
    scales = gaussian_map.scales[rows]
    np.maximum(scales, np.finfo(np.float32).tiny, out=scales)
    rotations = gaussian_map.rotations[rows]
    norms = np.linalg.norm(rotations.astype(np.float64), axis=1)
    valid &= norms > 0
    rotations /= np.where(norms > 0, norms, 1.0)[:, None]
    if not valid.all():
        for name in _ARRAYS:
            stored = getattr(gaussian_map, name)[rows]
            stored[: np.count_nonzero(valid)] = stored[valid]
    return valid


class _Steps:
    """Whether single precision tells positions as finely as the Gaussians are small, and as it should."""

    def __init__(self) -> None:
        self._too_coarse = self._coarse = 0
        self._largest = 0.0

    def take(self, block: Block, scales: np.ndarray, valid: np.ndarray) -> None:
        """Look at the `valid` Gaussians of a block, whose scales are (m, 3)."""
        step = np.broadcast_to(block.step, len(valid))[valid]
        self._too_coarse += int(np.count_nonzero(step > scales.max(axis=1, initial=0.0)))
        self._coarse += int(np.count_nonzero(step > _COARSE_STEP))
        self._largest = max(self._largest, float(step.max(initial=0.0)))

    def check(self, path: Path, count: int) -> None:
        """Raise MapError where most of `count` Gaussians are smaller than the steps of their positions."""
        if self._too_coarse > 0.5 * count:
            raise MapError(
                f"{path}: its positions are so far from the origin that single precision tells them to "
                f"{self._largest:.2g} units only, more than most of its Gaussians are large: export it in double "
                f"precision, or train and export it near the origin, and set map.translation"
            )

    def notes(self, count: int) -> list[str]:
        """Return what there is to say of the precision of `count` Gaussians."""
        if self._coarse <= 0.5 * count:
            return []
        return [f"far from the origin, single precision tells the positions to {self._largest:.2g} units only"]
