"""A large map prepared in a file, with little memory: its Gaussians are sorted in parts that lie on the disk.

Once through the map to see what there is; once more to deal its Gaussians out to buckets, of which each holds a part of
the order in which they are drawn; then bucket after bucket is sorted and becomes chunks.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsfeatloc_ros.maps import GaussianMap, MapError, ReadOptions, gather_map
from gsfeatloc_ros.maps.assemble import MAX_BLOCK_ROWS, Block, Intake, Layout, check_memory, empty_map
from gsfeatloc_ros.render.base import MIN_ALPHA
from gsfeatloc_ros.render.cache_file import Header, create, seal
from gsfeatloc_ros.render.chunks import CHUNK, KERNEL_LOCK, PreparedMap
from gsfeatloc_ros.render.levels import merge_levels
from gsfeatloc_ros.render.prepare import Grid, drawing_keys, drawing_order, fill_chunks, sample_step

# What a Gaussian takes in a bucket but for its harmonics, float32: mean, scales, rotation, opacity.
_COLUMNS = 11
# A bucket is of about so many bytes; what is made of it in memory takes four times as much. No more files than a
# process may have open.
_BUCKET_BYTES, _MAX_BUCKETS = 1 << 25, 500


@dataclass(frozen=True, eq=False)
class Survey:
    """What is known of a map that was read once.

    Attributes:
        path, options: of the map, no bundle.
        described: the map without its Gaussians.
        sh_coefficients: spherical harmonics per colour channel.
        count: Gaussians that can be seen.
        grid: in which they are sorted.
        sample: (m,) uint64, ascending, their place in the order of drawing, of some of them.
    """

    path: Path
    options: ReadOptions
    described: GaussianMap
    sh_coefficients: int
    count: int
    grid: Grid
    sample: np.ndarray


def survey(path: Path, layout: Layout, blocks: Iterable[Block], options: ReadOptions) -> Survey:
    """Read a map once; see `gather_map`.

    Raises:
        MapError: it cannot be used.
    """
    intake, count, step, found = Intake(path, layout, options), 0, sample_step(layout.count), []
    for part in _seen(intake, layout, blocks):
        chosen = slice(-count % step, None, step)
        found.append((part.means[chosen].copy(), part.scales[chosen].copy()))
        count += len(part)
    described = intake.described(empty_map(0, layout.sh_coefficients))
    if not found:
        raise MapError(f"{path}: nothing in it can be seen: was its training, or its export, broken off?")
    means, scales = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    grid = Grid.of(means, scales, layout.count)
    with KERNEL_LOCK:
        sample = drawing_keys(means, scales, grid, np.arange(len(means), dtype=np.uint64))
    sample = np.sort(sample >> np.uint64(grid.index_bits))
    return Survey(path, options, described, layout.sh_coefficients, count, grid, sample)


def prepare_in_file(found: Survey, stream: BinaryIO, origin: dict[str, Any], folder: Path) -> None:
    """Prepare a map, as `prepare` does, in a file; see `cache_file.create`.

    Args:
        found: what a survey of the map found.
        stream, origin: the file, and what it is of.
        folder: of the buckets; they are gone afterwards, whatever happens.

    Raises:
        MapError: it cannot be used, or was changed meanwhile.
        OSError: there is no room for the file.
    """
    described = found.described
    header = Header(
        leaves=-(-found.count // CHUNK),
        coarser=True,
        sh_coefficients=found.sh_coefficients,
        antialiased=described.antialiased,
        offset=tuple(described.S_map_splat.translation.tolist()),
        reading=described.reading,
    )
    with ExitStack() as stack:
        buckets = _Buckets(found, folder, stack)
        needed, free = buckets.size + header.size(), shutil.disk_usage(folder).free
        if free < needed:
            raise MapError(
                f"{found.path}: takes {1e-9 * needed:.1f} GB of disk in {folder} to prepare, and {1e-9 * free:.1f} GB "
                f"are free: make room there"
            )
        if gather_map(found.path, found.options, buckets.deal) != found.count:
            raise MapError(f"{found.path}: was changed while it was read: load it again")
        prepared = create(stream, header, origin)
        buckets.fill(prepared)
    merge_levels(prepared)
    seal(stream, prepared)


def _seen(intake: Intake, layout: Layout, blocks: Iterable[Block]) -> Iterator[GaussianMap]:
    """Yield the Gaussians of each block that can be seen, if there are any."""
    room = empty_map(MAX_BLOCK_ROWS, layout.sh_coefficients)
    for block in blocks:
        stored = intake.take(block, room, 0)
        seen = np.flatnonzero(room.opacities[:stored] >= MIN_ALPHA)
        if len(seen):
            yield GaussianMap(
                means=room.means[seen],
                scales=room.scales[seen],
                rotations=room.rotations[seen],
                opacities=room.opacities[seen],
                sh=room.sh[seen],
            )


class _Buckets:
    """Files of Gaussians, those of each before those of the next in the order of drawing.

    Args:
        found: what a survey of the map found.
        folder: of the files.
        stack: closes, and so removes, the files.
    """

    def __init__(self, found: Survey, folder: Path, stack: ExitStack) -> None:
        self._found = found
        self._columns = _COLUMNS + 3 * found.sh_coefficients
        self.size = 4 * self._columns * found.count
        count = min(-(-self.size // _BUCKET_BYTES), _MAX_BUCKETS)
        self._files = []
        for _ in range(count):
            self._files.append(stack.enter_context(tempfile.TemporaryFile(dir=folder)))  # noqa: SIM115
        self._borders = found.sample[len(found.sample) * np.arange(1, count) // count]

    def deal(self, path: Path, layout: Layout, blocks: Iterable[Block], options: ReadOptions) -> int:
        """Write each Gaussian that can be seen to the bucket of its place; return how many there are."""
        grid, count = self._found.grid, 0
        for part in _seen(Intake(path, layout, options), layout, blocks):
            with KERNEL_LOCK:
                keys = drawing_keys(part.means, part.scales, grid, np.arange(len(part), dtype=np.uint64))
            bucket = np.searchsorted(self._borders, keys >> np.uint64(grid.index_bits), side="right")
            order = np.argsort(bucket, kind="stable")
            opacities, sh = part.opacities[:, None], part.sh.reshape(len(part), -1)
            rows = np.concatenate([part.means, part.scales, part.rotations, opacities, sh], axis=1)[order]
            ends = np.searchsorted(bucket[order], np.arange(len(self._files)), side="right")
            for file, begin, end in zip(self._files, [0, *ends[:-1]], ends, strict=True):
                if end > begin:
                    file.write(rows[begin:end].data)
            count += len(part)
        return count

    def fill(self, prepared: PreparedMap) -> None:
        """Sort bucket after bucket, and make chunks of them."""
        left, chunk = np.empty((0, self._columns), np.float32), 0
        for file in self._files:
            size = file.tell()
            check_memory(self._found.path, 4 * size)
            file.seek(0)
            # Those that are left begin the next chunk: they come before all that follow.
            rows = np.concatenate([left, np.frombuffer(file.read(size), np.float32).reshape(-1, self._columns)])
            file.close()
            full = len(rows) if file is self._files[-1] else len(rows) - len(rows) % CHUNK
            end = chunk + -(-full // CHUNK)
            columns = (slice(0, 3), slice(3, 6), slice(6, 10), 10, slice(_COLUMNS, None))
            means, scales, *others = (np.ascontiguousarray(rows[:, column]) for column in columns)
            gaussians = np.empty((end - chunk, *prepared.gaussians.shape[1:]), np.float32)
            sh = np.empty((end - chunk, *prepared.sh.shape[1:]), np.float16)
            boxes = prepared.low[chunk:end], prepared.high[chunk:end]
            with KERNEL_LOCK:
                order = drawing_order(means, scales, self._found.grid, np.arange(len(rows), dtype=np.uint64))
                fill_chunks(order[:full], means, scales, *others, gaussians, sh.view(np.int16), *boxes)
            prepared.gaussians[chunk:end], prepared.sh[chunk:end] = gaussians, sh
            left, chunk = rows[order[full:]], end
