"""Maps as gsplat's PngCompression writes them, the forerunner of .sog: PNG images of values before their activation.

Layout: gsplat/compression/png_compression.py of https://github.com/nerfstudio-project/gsplat
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsfeatloc_ros.common.jpeg_png import read_header
from gsfeatloc_ros.maps.assemble import (
    MAX_COMPRESSION_RATIO,
    Block,
    Gather,
    Layout,
    T,
    block_slices,
    check_count,
    read_packed,
)
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, MapError
from gsfeatloc_ros.maps.options import ReadOptions

# What is stored of a Gaussian: the number of its values.
_VALUES = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "sh0": 3}


def is_gsplat_png(meta: object) -> bool:
    """Return whether a meta.json is that of such a folder: it gives each part a shape and no files."""
    parts = meta.values() if isinstance(meta, dict) else ()
    return bool(parts) and all(isinstance(part, dict) and "shape" in part and "files" not in part for part in parts)


def read_gsplat_png(path: Path, meta: dict[str, Any], options: ReadOptions, gather: Gather[T]) -> T:
    """Read a map from the meta.json, already parsed, of a folder that gsplat wrote.

    Raises:
        MapError: a file is missing, damaged or of another size than meta.json says.
        OSError: one cannot be read.
    """
    try:
        count = int(meta["means"]["shape"][0])
        check_count(path, count)
        if missing := [name for name in _VALUES if name not in meta]:
            raise MapError(f"{path}: lacks {', '.join(missing)} of a map of gsplat's PngCompression")
        values = {name: _values(path, name, meta[name], count) for name in _VALUES}
        coefficients = int(meta["shN"]["shape"][1]) + 1 if "shN" in meta else 1
        harmonics = _harmonics(path, meta["shN"], count) if coefficients > 1 else None
    except MapError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, EOFError, RecursionError, zipfile.BadZipFile) as error:
        raise MapError(f"{path}: is damaged: {type(error).__name__}: {error}") from error
    unused = [name for name in meta if name not in (*_VALUES, "shN")]
    notes = [f"values that are not used: {', '.join(unused)}"] if unused else []
    layout = Layout(count, min(coefficients, SH_COEFFICIENTS[-1]), None, tuple(notes))
    return gather(path, layout, _blocks(count, values, harmonics), options)


def _values(path: Path, name: str, meta: dict[str, Any], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return whole numbers (count, n) of the images of one part, and what 0 and 1 in the next (n,) stand for a step."""
    low, high = (np.atleast_1d(np.array(meta[key], np.float64)) for key in ("mins", "maxs"))
    if low.shape != (_VALUES[name],) or high.shape != low.shape or int(meta["shape"][0]) != count:
        raise ValueError(f"{name} has bounds or a shape of other sizes")
    if name == "means":
        low_bytes, high_bytes = (_image(path, f"means_{part}", count).astype(np.uint16) for part in "lu")
        numbers = low_bytes | high_bytes << 8
    else:
        numbers = _image(path, name, count)
    if numbers.shape[1] != _VALUES[name]:
        raise ValueError(f"{name}.png has {numbers.shape[1]} channels")
    return numbers, low, (high - low) / (65535 if name == "means" else 255)


def _image(path: Path, name: str, count: int) -> np.ndarray:
    """Return the pixels (count, channels) uint8 of an image whose size is looked up before memory is taken for it."""
    file = path.parent / f"{name}.png"
    if not file.is_file():
        raise MapError(f"{path}: lacks a file: {file} is missing")
    data = read_packed(path, file)
    side = math.isqrt(count)
    if data[:8] != b"\x89PNG\r\n\x1a\n" or len(data) < 24:
        raise MapError(f"{path}: {file.name} is no PNG image")
    if side * side != count or data[16:24] != side.to_bytes(4, "big") * 2 or count > MAX_COMPRESSION_RATIO * len(data):
        raise MapError(f"{path}: {file.name} does not have the {count} pixels of a square that meta.json says")
    try:
        image = cv2.imdecode(np.frombuffer(read_header(data).data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.dtype != np.uint8 or image.shape[:2] != (side, side):
        raise MapError(f"{path}: {file.name} is truncated or damaged")
    pixels = image.reshape(count, -1)
    return pixels if pixels.shape[1] < 3 else pixels[:, [2, 1, 0, *range(3, pixels.shape[1])]]


def _harmonics(path: Path, meta: dict[str, Any], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the centroids (K, C - 1, 3) float32 of the harmonics beyond the first, and which (count,) each has."""
    coefficients = int(meta["shape"][1])
    if math.isqrt(coefficients + 1) ** 2 != coefficients + 1 or list(meta["shape"]) != [count, coefficients, 3]:
        raise ValueError(f"shN has the shape {meta['shape']}")
    file = path.parent / "shN.npz"
    if not file.is_file():
        raise MapError(f"{path}: lacks a file: {file} is missing")
    data = read_packed(path, file)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(member.file_size for member in archive.infolist()) > MAX_COMPRESSION_RATIO * len(data):
            raise MapError(f"{path}: is damaged: shN.npz claims to unpack to too much")
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        centroids, labels = arrays["centroids"], arrays["labels"]
    low, high = float(meta["mins"]), float(meta["maxs"])
    if labels.shape != (count,) or centroids.shape[1:] != (3 * coefficients,) or labels.max() >= len(centroids):
        raise ValueError("shN.npz does not fit its shape")
    values = low + centroids.astype(np.float32) / (2 ** int(meta["quantization"]) - 1) * (high - low)
    return values.reshape(len(centroids), coefficients, 3)[:, : SH_COEFFICIENTS[-1] - 1], labels


def _blocks(
    count: int,
    values: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]],
    harmonics: tuple[np.ndarray, np.ndarray] | None,
) -> Iterator[Block]:
    """Yield runs of Gaussians, activated."""

    def of(name: str, rows: slice) -> np.ndarray:
        numbers, low, step = values[name]
        return low + numbers[rows] * step

    for rows in block_slices(count):
        logarithms = of("means", rows)
        sh = of("sh0", rows)[:, None]
        if harmonics is not None:
            centroids, labels = harmonics
            sh = np.concatenate([sh, centroids[labels[rows]]], axis=1)
        yield Block(
            means=np.sign(logarithms) * np.expm1(np.abs(logarithms)),
            scales=np.exp(of("scales", rows)),
            rotations=of("quats", rows),
            opacities=1.0 / (1.0 + np.exp(-of("opacities", rows)[:, 0])),
            sh=sh,
        )
