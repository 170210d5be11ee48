"""Maps as .sog, the format of PlayCanvas: values as the pixels of lossless WebP images, described by a meta.json.

Layout: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog; of version 1, which differs in how
bytes become values: read-sog-v1.ts of https://github.com/playcanvas/splat-transform
"""

from __future__ import annotations

import itertools
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsfeatloc_ros.maps.assemble import (
    MAX_PACKED_BYTES,
    Block,
    Gather,
    Layout,
    T,
    block_slices,
    check_compression,
    check_count,
    read_packed,
)
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, MapError
from gsfeatloc_ros.maps.options import ReadOptions

# A meta.json with all codebooks takes 16 KB.
_MAX_META_BYTES = 1 << 20
# Means, quaternions, scales, colour and opacity of a Gaussian, which hardly compress.
_MIN_BYTES_PER_GAUSSIAN = 17
# What zipfile raises on damage: the last two for features that it does not have and for passwords.
ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    UnicodeDecodeError,
    NotImplementedError,
    RuntimeError,
)
_PALETTE_WIDTH, _MAX_PALETTE_SIZE = 64, 1 << 16
# Of meta.json; asset tells the program that wrote it, extras are for applications.
_META_KEYS = ("version", "count", "model", "antialias", "asset", "extras", "means", "scales", "quats", "sh0", "shN")


@dataclass(frozen=True, eq=False)
class _Sog:
    """What meta.json says. A table (256, channels) float32 gives the value of each byte in each channel."""

    count: int
    bands: int | None  # degree of the harmonics beyond the first; None: the palette's width tells
    mean_bounds: np.ndarray  # (2, 3)
    scales: np.ndarray  # (256, 3) logarithms
    colors: np.ndarray  # (256, 3) coefficients of the first harmonic
    opacities: np.ndarray  # (256,)
    harmonics: np.ndarray | None  # (256,)
    antialiased: bool | None
    notes: tuple[str, ...]
    files: dict[str, list[str]]


def read_sog(path: Path, options: ReadOptions, gather: Gather[T]) -> T:
    """Read a map from a .sog file, a zip of its files or of the folder with them.

    Raises:
        MapError: a file in it is missing, truncated, damaged, of another version or not lossless.
        OSError: it cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            folder = _folder_of_meta(path, archive)
            meta_json = _read_member(path, archive, folder + "meta.json", _MAX_META_BYTES)
            layout, blocks = open_sog(path, meta_json, lambda name: _read_member(path, archive, folder + name))
            return gather(path, layout, blocks, options)
    except ZIP_ERRORS as error:
        raise MapError(f"{path}: is truncated or damaged: {error}") from error


def read_meta(path: Path) -> object:
    """Return the content of the meta.json in a .sog; raise as `read_sog`."""
    try:
        with zipfile.ZipFile(path) as archive:
            return json.loads(
                _read_member(path, archive, _folder_of_meta(path, archive) + "meta.json", _MAX_META_BYTES)
            )
    except ZIP_ERRORS as error:
        raise MapError(f"{path}: is truncated or damaged: {error}") from error


def read_unbundled_sog(path: Path, options: ReadOptions, gather: Gather[T]) -> T:
    """Read a map from the meta.json of an unbundled .sog.

    Raises:
        MapError: a file is missing, truncated, damaged, of another version or not lossless.
        OSError: one cannot be read.
    """
    return gather(path, *open_unbundled_sog(path), options)


def open_unbundled_sog(path: Path) -> tuple[Layout, Iterator[Block]]:
    """Return what the meta.json of an unbundled .sog says, and its Gaussians; raise as `read_unbundled_sog`."""
    meta_json = _read_file(path, path, _MAX_META_BYTES)
    return open_sog(path, meta_json, lambda name: _read_file(path, path.parent / name))


def _read_file(path: Path, file: Path, limit: int = MAX_PACKED_BYTES) -> bytes:
    if not file.is_file():
        raise MapError(f"{path}: lacks a file: {file} is missing")
    return read_packed(path, file, limit)


def _folder_of_meta(path: Path, archive: zipfile.ZipFile) -> str:
    """Return the folder in a zip, empty or with a slash at its end, that holds the one meta.json."""
    found = [name[: -len("meta.json")] for name in archive.namelist() if name.rpartition("/")[2] == "meta.json"]
    if len(found) != 1:
        raise MapError(f"{path}: is a zip with {len(found)} meta.json, so no .sog or a damaged one")
    return found[0]


def _read_member(path: Path, archive: zipfile.ZipFile, name: str, limit: int = MAX_PACKED_BYTES) -> bytes:
    if name not in archive.namelist():
        raise MapError(f"{path}: is a .sog without {name}, so a damaged one")
    member = archive.getinfo(name)
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise MapError(f"{path}: {name} is compressed in a way that a .sog is not: zip it with deflate or without")
    if member.file_size > limit:
        raise MapError(f"{path}: is damaged: {name} claims {member.file_size} bytes, which is too many for a .sog")
    # So much memory is taken to read it, and so much it may unpack to.
    if member.compress_size > path.stat().st_size:
        raise MapError(f"{path}: is truncated or damaged: {name} claims to take {member.compress_size} bytes of it")
    check_compression(path, member.file_size, member.compress_size)
    return archive.read(member)


def describe_unbundled_sog(path: Path) -> Layout:
    """Return what the meta.json of an unbundled .sog of version 2 says, without decoding its images."""
    sog = _parse(path, _read_file(path, path, _MAX_META_BYTES))
    if sog.bands is None and "palette" in sog.files:
        raise MapError(f"{path}: is a .sog of version 1, which is not read as a part of a streamed one")
    files = [path.parent / name for name in itertools.chain(*sog.files.values())]
    if missing := [file for file in files if not file.is_file()]:
        raise MapError(f"{path}: lacks a file: {missing[0]} is missing")
    check_compression(path, _MIN_BYTES_PER_GAUSSIAN * sog.count, sum(file.stat().st_size for file in files))
    return Layout(sog.count, SH_COEFFICIENTS[sog.bands or 0], sog.antialiased, sog.notes)


def open_sog(path: Path, meta_json: bytes, read: Callable[[str], bytes]) -> tuple[Layout, Iterator[Block]]:
    """Return what a meta.json says, and its Gaussians; `read` gives the contents of the images that it names."""
    sog = _parse(path, meta_json)
    images = {key: [read(name) for name in names] for key, names in sog.files.items()}
    check_compression(
        path, _MIN_BYTES_PER_GAUSSIAN * sog.count, sum(len(data) for group in images.values() for data in group)
    )
    pixels = {
        key: [_decode(path, name, data, sog.count) for name, data in zip(sog.files[key], group, strict=True)]
        for key, group in images.items()
        if key != "palette"
    }
    palette = _decode_palette(path, sog, images["palette"][0]) if "palette" in images else None
    del images
    coefficients = 1 if palette is None else 1 + palette.shape[1]
    return Layout(sog.count, coefficients, sog.antialiased, sog.notes), _blocks(path, sog, pixels, palette)


def _parse(path: Path, meta_json: bytes) -> _Sog:
    """Read a meta.json; refuse names of files that lead out of its folder."""
    try:
        sog = _parse_meta(path, json.loads(meta_json))
    except MapError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, RecursionError) as error:
        what = f"{type(error).__name__}: {error}"
        raise MapError(f"{path}: meta.json is damaged or not that of a .sog ({what})") from error
    for name in itertools.chain(*sog.files.values()):
        if not isinstance(name, str) or name in ("", ".", "..") or any(c in name for c in "/\\:\0"):
            raise MapError(f"{path}: meta.json names the image {name!r}, which is no plain file name")
    check_count(path, sog.count)
    return sog


def _parse_meta(path: Path, meta: dict) -> _Sog:
    if not isinstance(meta, dict):
        raise TypeError("it is no object")
    version = meta.get("version", 1)
    if version not in (1, 2):
        raise MapError(f"{path}: is a .sog of version {version}; versions 1 and 2 are read")
    model = meta.get("model")
    if model == "2dgs":
        raise MapError(f"{path}: is a 2D Gaussian splatting (2DGS) map; only 3D ones are read")
    if model not in (None, "default", "antialiased"):
        raise MapError(f"{path}: is of a model that is not known: {model!r}")
    files = {"means": meta["means"]["files"][:2]}
    files |= {key: meta[key]["files"][:1] for key in ("scales", "quats", "sh0")}
    rest = meta.get("shN")
    bands = _whole(rest["bands"]) if rest and version == 2 else None
    if bands is not None and bands >= len(SH_COEFFICIENTS):
        raise MapError(f"{path}: has spherical harmonics of degree {bands}; those of 0 to 3 are read")
    if not rest or bands == 0:
        rest = None
    else:
        files |= {"palette": rest["files"][:1], "labels": rest["files"][1:2]}
    if any(len(names) != (2 if key == "means" else 1) for key, names in files.items()):
        raise MapError(f"{path}: meta.json names too few images")

    bytes_ = np.arange(256)
    alphas = bytes_ / 255.0
    if version == 2:
        scales = _codebook(meta["scales"]["codebook"])[:, None].repeat(3, axis=1)
        colors = _codebook(meta["sh0"]["codebook"])[:, None].repeat(3, axis=1)
        opacities = alphas
        harmonics = _codebook(rest["codebook"]) if rest else None
    else:
        scales = _steps(meta["scales"], 3)
        steps = _steps(meta["sh0"], 4)
        colors, opacities = steps[:, :3], 1.0 / (1.0 + np.exp(-steps[:, 3]))
        harmonics = _steps(rest, 1)[:, 0] if rest else None
    return _Sog(
        count=_whole(meta["count"] if version == 2 else meta["means"]["shape"][0]),
        bands=bands,
        mean_bounds=np.stack([_numbers(meta["means"][key], 3) for key in ("mins", "maxs")]),
        scales=scales.astype(np.float32),
        colors=colors.astype(np.float32),
        opacities=opacities.astype(np.float32),
        harmonics=None if harmonics is None else harmonics.astype(np.float32),
        antialiased=_flag(meta.get("antialias")) if model is None else model == "antialiased",
        notes=tuple(f"meta.json's {key!r} is not known and not used" for key in meta if key not in _META_KEYS),
        files=files,
    )


def _flag(value: object) -> bool | None:
    if value not in (None, True, False):
        raise ValueError(f"{value!r} is no flag")
    return None if value is None else bool(value)


def _whole(value: object) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"{value!r} is no whole number")
    return value


def _numbers(values: object, count: int) -> np.ndarray:
    """Return finite numbers (count,) float64; raise ValueError for others."""
    numbers = np.atleast_1d(np.array(values, dtype=np.float64))
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"not {count} finite numbers: {values!r:.100}")
    return numbers


def _codebook(values: list) -> np.ndarray:
    """Return the values (256,) of all bytes; NaN beyond the codebook, so that Gaussians with these are refused."""
    numbers = _numbers(values, len(values))
    if len(numbers) > 256:
        raise ValueError(f"a codebook of {len(numbers)} values for bytes")
    return np.pad(numbers, (0, 256 - len(numbers)), constant_values=np.nan)


def _steps(bounds: dict, channels: int) -> np.ndarray:
    """Return the values (256, channels) of all bytes, in equal steps from the lowest to the highest."""
    low, high = _numbers(bounds["mins"], channels), _numbers(bounds["maxs"], channels)
    return np.linspace(low, high, 256)


def _decode(path: Path, name: str, data: bytes, count: int) -> np.ndarray:
    """Decode the pixels (count, 4) uint8 RGBA of an image with at least that many; `count` has been checked."""
    pixels = _decode_webp(path, name, data, count, 2 * count + (1 << 16))
    return pixels.reshape(-1, 4)[:count]


def _decode_palette(path: Path, sog: _Sog, data: bytes) -> np.ndarray:
    """Decode the bytes (palette, C - 1, 3) of the harmonics: 64 entries in a row of the image, C - 1 pixels each."""
    name = sog.files["palette"][0]
    pixels = _decode_webp(path, name, data, 1, _MAX_PALETTE_SIZE * SH_COEFFICIENTS[-1])
    coefficients, remainder = divmod(pixels.shape[1], _PALETTE_WIDTH)
    expected = SH_COEFFICIENTS[1:] if sog.bands is None else [SH_COEFFICIENTS[sog.bands]]
    if remainder or coefficients + 1 not in expected:
        raise MapError(f"{path}: {name} is {pixels.shape[1]} pixels wide, which does not fit its harmonics")
    return np.ascontiguousarray(pixels.reshape(-1, coefficients, 4)[..., :3])


def _decode_webp(path: Path, name: str, data: bytes, min_pixels: int, max_pixels: int) -> np.ndarray:
    """Decode the pixels (H, W, 4) uint8 RGBA of a lossless WebP; look up its size before memory is taken for it."""
    lossless = _lossless_chunk(path, name, data)
    bits = int.from_bytes(lossless[9:13], "little")
    width, height = 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if not min_pixels <= width * height <= max_pixels:
        raise MapError(f"{path}: {name} of {width} x {height} pixels does not fit the number of Gaussians")
    # The decoder is given nothing but what the size was read from: other chunks may tell of another.
    simple = b"RIFF" + (4 + len(lossless)).to_bytes(4, "little") + b"WEBP" + lossless
    try:
        image = cv2.imdecode(np.frombuffer(simple, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != (height, width) or image.shape[2:] not in ((3,), (4,)):
        raise MapError(f"{path}: {name} is truncated or damaged")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGBA if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)


def _lossless_chunk(path: Path, name: str, data: bytes) -> bytes:
    """Return the first lossless image among the chunks of a file (RFC 9649, 2.3 and 3.4)."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise MapError(f"{path}: {name} is not a WebP image")
    start = 12
    while start + 13 <= len(data):
        end = start + 8 + int.from_bytes(data[start + 4 : start + 8], "little")
        end += end % 2
        if data[start : start + 4] == b"VP8L":
            return data[start:end]
        start = end
    raise MapError(f"{path}: {name} is truncated or a lossy or animated WebP, whose pixels are not the map's values")


def _blocks(path: Path, sog: _Sog, pixels: dict[str, list[np.ndarray]], palette: np.ndarray | None) -> Iterator[Block]:
    """Yield runs of Gaussians, looked up in the tables."""
    (means_low, means_high), (scales,), (quats,), (sh0,) = (pixels[key] for key in ("means", "scales", "quats", "sh0"))
    low, high = sog.mean_bounds
    channels = np.arange(3)
    for rows in block_slices(sog.count):
        fractions = (means_low[rows, :3] + means_high[rows, :3] * 256.0) / 65535.0
        logarithms = low + (high - low) * fractions
        sh = sog.colors[sh0[rows, :3], channels][:, None]
        if palette is not None and sog.harmonics is not None:
            labels = pixels["labels"][0][rows].astype(np.int32)
            labels = labels[:, 0] + 256 * labels[:, 1]
            if labels.max() >= len(palette):
                raise MapError(f"{path}: is damaged: it refers to harmonics beyond the {len(palette)} of its palette")
            sh = np.concatenate([sh, sog.harmonics[palette[labels]]], axis=1)
        yield Block(
            means=np.sign(logarithms) * np.expm1(np.abs(logarithms)),
            scales=np.exp(sog.scales[scales[rows, :3], channels]),
            rotations=_unpack_rotations(path, quats[rows]),
            opacities=sog.opacities[sh0[rows, 3]],
            sh=sh,
        )


def _unpack_rotations(path: Path, rgba: np.ndarray) -> np.ndarray:
    """Decode quaternions (n, 4) wxyz of pixels (n, 4): three components, and 252 + the index of the largest."""
    if rgba[:, 3].min() < 252:
        raise MapError(f"{path}: is damaged: the image of the rotations has an alpha under 252")
    largest = rgba[:, 3:].astype(np.intp) - 252
    three = (rgba[:, :3] / np.float32(127.5) - 1.0) * np.float32(np.sqrt(0.5))
    quaternions = np.empty((len(rgba), 4), np.float32)
    np.put_along_axis(quaternions, np.arange(3) + (np.arange(3) >= largest), three, axis=1)
    rest = np.sqrt(np.maximum(1.0 - np.sum(three * three, axis=1, keepdims=True), 0.0))
    np.put_along_axis(quaternions, largest, rest, axis=1)
    return quaternions
