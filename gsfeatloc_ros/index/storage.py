"""View indices in files."""

from __future__ import annotations

import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsfeatloc_ros.common.kernel_cache import can_write, user_cache_folder
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.common.safe_files import UntrustedError, open_own
from gsfeatloc_ros.index.view_index import CODE_BYTES, ViewIndex
from gsfeatloc_ros.maps.bundle import map_in

SUFFIX = ".gsfeatloc-index"

# A file is this line, the SHA-256 of all that follows it, the length of the header (4 bytes, little-endian), the header
# (JSON) and the arrays one after another. The line changes with the format.
_MAGIC = b"gsfeatloc_ros view index 3\n"
_MAX_HEADER_BYTES = 64 * 1024
# Type and shape of the arrays; N views that show F landmarks, of L in all, D / CODE_BYTES numbers for each byte of a
# code, S look-alikes.
_ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    "poses": ("<f8", ("N", 4, 4)),
    "counts": ("<i4", ("N",)),
    "seen": ("<u4", ("F",)),
    "points": ("<u2", ("L", 3)),
    "codes": ("|u1", ("L", CODE_BYTES)),
    "centroids": ("<f2", (CODE_BYTES, 256, "D")),
    "low": ("<f8", (3,)),
    "high": ("<f8", (3,)),
    "look_alikes": ("<f8", ("S", 4, 4)),
}
_SIZES = {"N": (1, 1_000_000), "F": (1, 2**31 - 1), "L": (1, 2**31 - 1), "D": (1, 64), "S": (0, 1000)}


def index_path(map_path: str | Path) -> Path:
    """Return where the index of a map is kept: beside it, or in the user's cache where that cannot be written.

    One that lies beside the map already is taken where it is. Of a bundle it is beside the map in it.

    Raises:
        MapError: the manifest of a bundle cannot be used.
    """
    path = Path(os.path.abspath(map_in(map_path)))
    beside = path.with_name(path.name + SUFFIX)
    if beside.exists() or can_write(path.parent):
        return beside
    place = hashlib.sha256(str(path).encode()).hexdigest()[:16]
    return user_cache_folder() / "indices" / f"{path.name}-{place}{SUFFIX}"


def save_index(path: Path, index: ViewIndex, key: dict[str, Any]) -> None:
    """Write an index in one step: whoever reads it finds the old one or the whole new one.

    Args:
        path: file to write; its folder is made if need be.
        index: to write.
        key: what it was made of.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: np.ascontiguousarray(getattr(index, name), dtype) for name, (dtype, _) in _ARRAYS.items()}
    sizes = {
        "N": len(index),
        "F": len(index.seen),
        "L": len(index.codes),
        "D": index.centroids.shape[2],
        "S": len(index.look_alikes),
    }
    header = json.dumps({"key": key, "sizes": sizes}).encode()
    parts = [len(header).to_bytes(4, "little"), header, *(array.tobytes() for array in arrays.values())]
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    with replaced_file(path) as stream:
        stream.writelines([_MAGIC, digest.digest(), *parts])


def load_index(path: Path, key: dict[str, Any] | None = None) -> ViewIndex | None:
    """Read an index.

    Args:
        path: its file.
        key: what it has to be made of, whatever else it says that it was; None takes any.

    Returns:
        The index; None where there is no such file or it was made of something else.

    Raises:
        ValueError: it is no index or damaged.
        OSError: it cannot be read, or another user may have written it.
    """
    try:
        with open_own(path) as stream:
            return _read(stream, path, key)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except UntrustedError as error:
        raise UntrustedError(f"{path}: {error}, and it is made again") from None


def _read(stream: BinaryIO, path: Path, key: dict[str, Any] | None) -> ViewIndex | None:
    damaged = ValueError(f"{path}: is damaged: delete it, and it is made again")
    if stream.read(len(_MAGIC)) != _MAGIC:
        raise ValueError(f"{path}: is no index of views of this version: delete it, and it is made again")
    checksum, length_bytes = stream.read(32), stream.read(4)
    length = int.from_bytes(length_bytes, "little")
    if length > _MAX_HEADER_BYTES:
        raise damaged
    encoded = stream.read(length)
    try:
        header = json.loads(encoded)
        sizes = {name: int(header["sizes"][name]) for name in _SIZES}
        stored = dict(header["key"])
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise damaged from error
    if not all(least <= sizes[name] <= most for name, (least, most) in _SIZES.items()):
        raise damaged
    if key is not None and stored != {**stored, **key}:
        return None
    shapes = {
        name: tuple(sizes[size] if isinstance(size, str) else size for size in shape)
        for name, (_, shape) in _ARRAYS.items()
    }
    expected = sum(np.dtype(_ARRAYS[name][0]).itemsize * math.prod(shape) for name, shape in shapes.items())
    if expected != os.fstat(stream.fileno()).st_size - stream.tell():
        raise damaged
    digest = hashlib.sha256(length_bytes + encoded)
    arrays = {}
    for name, shape in shapes.items():
        array = np.fromfile(stream, _ARRAYS[name][0], math.prod(shape))
        digest.update(array.data)
        arrays[name] = array.reshape(shape)
    arrays["centroids"] = arrays["centroids"].astype(np.float32)
    index = ViewIndex(**arrays)
    counts = index.counts.astype(np.int64)
    finite = all(
        np.isfinite(getattr(index, name)).all() for name in ("poses", "centroids", "low", "high", "look_alikes")
    )
    adds_up = (counts >= 0).all() and counts.sum() == sizes["F"] and index.seen.max() < sizes["L"]
    if digest.digest() != checksum or not adds_up or not finite:
        raise damaged
    return index
