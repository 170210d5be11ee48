"""The Gaussians of a large map stay in a file: what a view needs is read when it is needed, and kept for the next."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from io import FileIO
from typing import BinaryIO

import numpy as np

from gsfeatloc_ros.render.base import StaleMapError
from gsfeatloc_ros.render.chunks import MAX_CHUNKS, PreparedMap

# Most parts that the system reads or writes in one call (IOV_MAX), and bytes of those that an array is cut into.
_PARTS, _PART_BYTES = 1024, 1 << 20


class StoredFile:
    """A file that is read, and while it is made written, at any place.

    It is not mapped into memory: what of that cannot be read any more, because the file was cut short or its disk
    fails, ends the process (SIGBUS). Here it is an exception.

    Args:
        stream: the file; it may be closed afterwards.
        status: of the file when it was looked at: a later change is an error. None: it is still written.
    """

    def __init__(self, stream: BinaryIO, status: os.stat_result | None = None) -> None:
        self.name = str(stream.name)
        self._file = FileIO(os.dup(stream.fileno()))
        self._stamp = None if status is None else _stamp(status)

    def read(self, offset: int, parts: list[np.ndarray]) -> None:
        """Fill contiguous arrays with what is in the file from `offset` on; raise OSError where that fails."""
        self._transfer(os.preadv, offset, parts, "was cut short")
        if self._stamp is not None and _stamp(os.fstat(self._file.fileno())) != self._stamp:
            raise OSError("was changed while it was in use")

    def write(self, offset: int, parts: list[np.ndarray]) -> None:
        """Write contiguous arrays one after another from `offset` on; raise OSError where that fails."""
        self._transfer(os.pwritev, offset, parts, "there is no room for it")

    def _transfer(self, transfer: Callable[..., int], offset: int, parts: list[np.ndarray], otherwise: str) -> None:
        """Read or write by a call of the system; raise OSError, where that does less, with what is so otherwise."""
        for first in range(0, len(parts), _PARTS):
            some = [part.data for part in parts[first : first + _PARTS]]
            size = sum(part.nbytes for part in some)
            if transfer(self._file.fileno(), some, offset) != size:
                raise OSError(otherwise)
            offset += size


class StoredArray:
    """An array in a file. A slice of it is a copy, in memory; what is assigned to a slice is written.

    Args:
        file: that it is in.
        start: where in it, bytes.
        dtype, shape: of the array.
    """

    def __init__(self, file: StoredFile, start: int, dtype: str, shape: tuple[int, ...]) -> None:
        self.file, self._start, self.dtype, self.shape = file, start, np.dtype(dtype), shape
        self._row = self.dtype.itemsize * int(np.prod(shape[1:]))

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> np.ndarray:
        first, last, _ = rows.indices(len(self))
        part = np.empty((max(last - first, 0), *self.shape[1:]), self.dtype)
        self.read(first, _parts(part))
        return part

    def __setitem__(self, rows: slice, part: np.ndarray) -> None:
        self.file.write(self._start + rows.indices(len(self))[0] * self._row, _parts(part))

    def read(self, first: int, parts: list[np.ndarray]) -> None:
        """Fill arrays with the rows from `first` on, one after another; raise OSError where that fails."""
        self.file.read(self._start + first * self._row, parts)

    def blocks(self, size: int) -> Iterator[np.ndarray]:
        """Yield all of it in blocks of about so many bytes; there is one at least."""
        step = max(size // max(self._row, 1), 1)
        for first in range(0, max(len(self), 1), step):
            yield self[first : first + step]


class Resident:
    """Those chunks of a map that are in memory: all, or of a map that stays in a file those last used.

    Attributes:
        gaussians: (slots, ROWS, CHUNK) float32, as in PreparedMap.
        sh: (slots, 3 C, CHUNK) float16.
    """

    def __init__(self, prepared: PreparedMap) -> None:
        # What is in the file, and the room for it.
        self._stored: list[tuple[StoredArray, np.ndarray]] = []
        self.gaussians, self.sh = self._room(prepared.gaussians), self._room(prepared.sh)
        # Where each chunk is, and what is in each slot, -1 for nothing; and in which view it was used last.
        self._slots = np.full(len(prepared.sizes), -1)
        self._chunks, self._used = np.full(len(self.gaussians), -1), np.zeros(len(self.gaussians), np.int64)
        self._views = 0

    def slots(self, chunks: np.ndarray) -> np.ndarray:
        """Return where in `gaussians` and `sh` chunks (n,) are, n up to MAX_CHUNKS, reading those that are not there.

        Raises:
            StaleMapError: they cannot be read any more.
        """
        if not self._stored:
            return chunks
        self._views += 1
        there = self._slots[chunks]
        self._used[there[there >= 0]] = self._views
        missing = np.sort(chunks[there < 0])
        if len(missing):
            free = np.sort(np.argsort(self._used, kind="stable")[: len(missing)])
            self._empty(free)
            try:
                self._read(missing, free)
            except OSError as error:
                name = self._stored[0][0].file.name
                raise StaleMapError(
                    f"the prepared map {name}: {error.strerror or error}: load the map again"
                ) from error
            self._slots[missing], self._chunks[free], self._used[free] = free, missing, self._views
        return self._slots[chunks]

    def _room(self, array: np.ndarray | StoredArray) -> np.ndarray:
        if isinstance(array, np.ndarray):
            return array
        room = np.empty((min(MAX_CHUNKS, len(array)), *array.shape[1:]), array.dtype)
        self._stored.append((array, room))
        return room

    def _empty(self, slots: np.ndarray) -> None:
        """Forget what is in some slots."""
        held = self._chunks[slots]
        self._slots[held[held >= 0]] = -1
        self._chunks[slots], self._used[slots] = -1, 0

    def _read(self, chunks: np.ndarray, slots: np.ndarray) -> None:
        """Read chunks, in ascending order, into as many slots: those that follow each other in the file at once."""
        for run in np.split(np.arange(len(chunks)), np.flatnonzero(np.diff(chunks) != 1) + 1):
            for array, room in self._stored:
                array.read(int(chunks[run[0]]), [room[slot] for slot in slots[run]])


def _parts(array: np.ndarray) -> list[np.ndarray]:
    """Return parts of a contiguous array, one after another, that are not too large to be read or written at once."""
    flat = array.reshape(-1).view(np.uint8)
    return [flat[first : first + _PART_BYTES] for first in range(0, len(flat), _PART_BYTES)]


def _stamp(status: os.stat_result) -> tuple[int, int]:
    """Return what a change of a file's content changes; to rename or delete it does not."""
    return status.st_size, status.st_mtime_ns
