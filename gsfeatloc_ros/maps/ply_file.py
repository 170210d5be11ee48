"""Files in the .ply format: header, sizes and rows, whatever they hold."""

from __future__ import annotations

import io
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from gsfeatloc_ros.maps.assemble import block_slices
from gsfeatloc_ros.maps.gaussian_map import MapError

# A header of 62 properties takes 1.5 KB; the rest is room for comments.
_MAX_HEADER_BYTES = 64 * 1024


class PlyFile:
    """The elements of a .ply file, binary or ascii, with their rows read block by block.

    The numbers that the header declares are checked against the file's size before any memory is taken for them.

    Attributes:
        path: of the file.
        trailing_bytes: number of bytes behind what a binary file's header declares; 0 where lists hide where that ends.

    Raises:
        MapError: the file is no .ply or is truncated.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as stream:
            head = io.BytesIO(stream.read(_MAX_HEADER_BYTES))
        try:
            # plyfile has no public call for the header alone; `PlyData.read` would take the memory that it declares.
            self._header = PlyData._parse_header(head)
        except (PlyParseError, ValueError) as error:
            raise MapError(f"{path}: has no valid .ply header: {error}") from error
        self._data_start = head.tell()
        self.trailing_bytes = self._check_size(path.stat().st_size - self._data_start)

    def __contains__(self, name: str) -> bool:
        return name in self._header

    def __getitem__(self, name: str) -> PlyElement:
        """Return the element called `name`, of which only what the header says of it is there."""
        return self._header[name]

    @property
    def elements(self) -> list[str]:
        """Names of the elements that have rows."""
        return [element.name for element in self._header if element.count]

    @property
    def comments(self) -> list[str]:
        """Comments of the header, in their order."""
        return [*self._header.comments, *(comment for element in self._header for comment in element.comments)]

    def blocks(self, name: str) -> Iterator[np.ndarray]:
        """Yield the rows of element `name`, which has no lists: structured arrays (n,) of at most MAX_BLOCK_ROWS."""
        element = self._header[name]
        before = self._header.elements[: self._header.elements.index(element)]
        read = self._read_ascii if self._header.text else self._read_binary
        return read(element, before)

    def _check_size(self, data_size: int) -> int:
        """Refuse a header that declares more than `data_size` bytes of data; return how many there are beyond these."""
        header = self._header
        if any(element.count < 0 for element in header):
            raise MapError(f"{self.path}: declares a negative number of elements")
        if header.text:
            # Each value takes a digit and a separator; the last separator of the file may be missing.
            declared = sum(element.count * 2 * max(1, len(element.properties)) for element in header) - 1
            exact = False
        else:
            fixed = [element for element in header if not _lists(element)]
            declared = sum(element.count * element.dtype(header.byte_order).itemsize for element in fixed)
            exact = len(fixed) == len(header)
        if data_size < declared:
            raise MapError(f"{self.path}: is truncated: the header declares {declared} bytes of data, not {data_size}")
        return data_size - declared if exact else 0

    def _read_binary(self, element: PlyElement, before: list[PlyElement]) -> Iterator[np.ndarray]:
        offset = self._data_start
        for other in before:
            if _lists(other):
                raise MapError(f"{self.path}: has list properties in element '{other.name}' before '{element.name}'")
            offset += other.count * other.dtype(self._header.byte_order).itemsize
        dtype = np.dtype(element.dtype(self._header.byte_order))
        with self.path.open("rb") as stream:
            stream.seek(offset)
            for rows in block_slices(element.count):
                block = np.fromfile(stream, dtype, rows.stop - rows.start)
                if len(block) < rows.stop - rows.start:
                    raise MapError(f"{self.path}: is truncated")
                yield block

    def _read_ascii(self, element: PlyElement, before: list[PlyElement]) -> Iterator[np.ndarray]:
        dtype = np.dtype(element.dtype("="))
        with self.path.open("rb") as stream:
            stream.seek(self._data_start)
            for _ in islice(stream, sum(other.count for other in before)):
                pass
            for rows in block_slices(element.count):
                lines = [line.decode("latin-1") for line in islice(stream, rows.stop - rows.start) if line.strip()]
                if len(lines) < rows.stop - rows.start:
                    raise MapError(f"{self.path}: is truncated")
                try:
                    yield np.loadtxt(lines, dtype, comments=None, ndmin=1)
                except (ValueError, OverflowError) as error:
                    raise MapError(f"{self.path}: is damaged: {error}") from error


def check_no_lists(ply: PlyFile, element: PlyElement) -> None:
    """Refuse an element of a map's Gaussians that has list properties."""
    if names := _lists(element):
        raise MapError(f"{ply.path}: element '{element.name}' has list properties ({', '.join(names)}); a map has none")


def columns(rows: np.ndarray, names: list[str], dtype: np.dtype | type = np.float32) -> np.ndarray:
    """Copy the named fields of the rows (n,) into an array (n, len(names))."""
    out = np.empty((len(rows), len(names)), dtype=dtype)
    with np.errstate(over="ignore", invalid="ignore"):  # what does not fit is refused by its value
        for index, name in enumerate(names):
            out[:, index] = rows[name]
    return out


def _lists(element: PlyElement) -> list[str]:
    return [property_.name for property_ in element.properties if isinstance(property_, PlyListProperty)]
