"""What the fuzz campaign feeds: valid inputs of each kind, and what reads them.

A reader returns whether it took the input; ValueError and OSError are refusals, anything else is a crash.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import math
import struct
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bags
import cv2
import map_files
import numpy as np
from room_datasets import write_colmap
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore
from view_indices import made_up_index

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.jpeg_png import decode, read_header
from gsfeatloc_ros.evaluate import colmap, nerfstudio
from gsfeatloc_ros.index import storage
from gsfeatloc_ros.index.storage import load_index, save_index
from gsfeatloc_ros.maps import GaussianMap, load_map, read_dataparser_transforms
from gsfeatloc_ros.maps.gaussian_map import Reading
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.render import cache_file
from gsfeatloc_ros.replay.bag import Role, open_bag
from gsfeatloc_ros.ros_io.calibration import decode_camera
from gsfeatloc_ros.ros_io.decode import decode_pose
from gsfeatloc_ros.ros_io.raw_image import decode_image
from gsfeatloc_ros.ros_io.saved_pose import load_pose, save_pose

_ORIGIN = {"code": "c", "map": [[1, "d"]]}
_CACHES = [cache_file.Header(2, coarser, 4, False, (0.0, 0.0, 0.0), Reading()) for coarser in (False, True)]
_TYPES = get_typestore(Stores.ROS2_JAZZY)


@dataclass(frozen=True)
class Target:
    """Something that reads what comes from outside.

    Attributes:
        seeds: valid inputs.
        read: reads one from a file; raises ValueError or OSError to refuse it.
        sign: makes checksums fit what was changed, so that what is behind them is reached; None where there are none.
    """

    seeds: list[bytes]
    read: Callable[[Path], Any]
    sign: Callable[[bytes], bytes] | None = None


def targets(folder: Path) -> dict[str, Target]:
    """Return all targets by name; `folder` is theirs."""
    return _maps(folder) | _kept(folder) | _datasets(folder) | _messages() | _bags(folder)


def _maps(folder: Path) -> dict[str, Target]:
    sample = map_files.sample_map(20, 1, 0)
    path = folder / "map"
    write_ply(path, sample)
    found = {"map ply": path.read_bytes()}
    found["map compressed ply"] = map_files.write_compressed_ply(path, sample).read_bytes()
    found["map splat"] = map_files.write_splat(path, sample).read_bytes()
    found["map spz 4"] = map_files.write_spz(path, sample, 4).read_bytes()
    for version in (1, 2):
        written = map_files.write_sog(folder / f"sog{version}", sample, version)
        found[f"map sog {version}"] = map_files.bundle(path, written).read_bytes()
    unpacked = {f"map spz {version}": _unpacked_spz(path, sample, version) for version in (1, 2, 3)}
    return unpacked | {name: Target([content], load_map) for name, content in found.items()}


def _unpacked_spz(path: Path, sample: GaussianMap, version: int) -> Target:
    """What is in the gzip is changed: it has a checksum of its own."""
    content = gzip.decompress(map_files.write_spz(path, sample, version).read_bytes())
    return Target([content], load_map, lambda changed: gzip.compress(changed, 1))


def _kept(folder: Path) -> dict[str, Target]:
    """What the package itself wrote, with checksums that fit."""
    path = folder / "kept"
    caches = []
    for header in _CACHES:
        with path.open("w+b") as file:
            cache_file.seal(file, cache_file.create(file, header, _ORIGIN))
        caches.append(path.read_bytes())
    found = {"cache": Target(caches, _read_cache, _signed_cache)}
    save_index(path, made_up_index(views=3, features=4, dimension=64).index, {"map": 1})
    index = path.read_bytes()
    found["index"] = Target([index], load_index, _signed_index)
    save_pose(path, np.eye(4), {"path": "map"})
    found["saved pose"] = Target([path.read_bytes()], lambda p: load_pose(p, {"path": "map"}))
    return found


def _read_cache(path: Path) -> Any:
    try:
        with path.open("rb") as stream:
            return cache_file.read(stream, _ORIGIN, large=256)
    except cache_file.CacheError as error:
        raise ValueError(str(error)) from error


def _signed_cache(content: bytes) -> bytes:
    """With checksums that fit, those of the arrays where all of them are there."""
    start = len(cache_file.MAGIC)
    numbers = start + 4 * (2 + len(cache_file.ARRAYS))
    end = numbers + int.from_bytes(content[start : start + 4], "little")
    parts = [content[numbers:end]]
    for header in _CACHES:
        sizes = [np.dtype(dtype).itemsize * math.prod(shape) for dtype, shape in header.layout().values()]
        if end + sum(sizes) == len(content):
            ends = end + np.cumsum(sizes)
            parts += [content[place - size : place] for place, size in zip(ends, sizes, strict=True)]
    signed = b"".join(zlib.crc32(part).to_bytes(4, "little") for part in parts)
    return content[: start + 4] + signed + content[start + 4 + len(signed) :]


def _signed_index(content: bytes) -> bytes:
    start = len(storage._MAGIC)
    return content[:start] + hashlib.sha256(content[start + 32 :]).digest() + content[start + 32 :]


def _datasets(folder: Path) -> dict[str, Target]:
    transforms = {"transform": np.eye(4)[:3].tolist(), "scale": 0.5}
    frames = {"fl_x": 4.0, "fl_y": 4, "cx": 4, "cy": 3, "w": 8, "h": 6, "test_filenames": ["a.png"]}
    frames["frames"] = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
    found = {
        "dataparser transforms": Target([json.dumps(transforms).encode()], read_dataparser_transforms),
        "nerfstudio": Target([json.dumps(frames).encode()], lambda path: nerfstudio.load(_as(path, "transforms.json"))),
    }
    for text in (False, True):
        scene = folder / f"colmap{text}"
        images = [(f"{name}.png", 0, np.eye(4)) for name in "ab"]
        write_colmap(scene, [("PINHOLE", 8, 6, [4, 4, 4, 3])], images, text)
        for file in sorted((scene / "sparse/0").iterdir()):
            found[f"colmap {file.name}"] = Target([file.read_bytes()], _read_colmap(scene, file))
    return found


def _as(path: Path, name: str) -> Path:
    """Return the folder of a copy of a file under another name."""
    (path.parent / name).write_bytes(path.read_bytes())
    return path.parent


def _read_colmap(scene: Path, file: Path) -> Callable[[Path], Any]:
    good = file.read_bytes()

    def read(path: Path) -> Any:
        file.write_bytes(path.read_bytes())
        try:
            return colmap.load(scene)
        finally:
            file.write_bytes(good)

    return read


def _messages() -> dict[str, Target]:
    """Pictures, and messages as they come over the wire (CDR)."""
    rgb = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
    pictures = [cv2.imencode(suffix, rgb)[1].tobytes() for suffix in (".jpg", ".png")]
    pictures.append(cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes())
    camera = Camera(16, 12, np.array([[9.0, 0, 8], [0, 9, 6], [0, 0, 1]]), np.zeros(5))
    found = {"picture": Target(pictures, lambda path: decode(read_header(path.read_bytes())))}
    samples = {
        "image": (bags.image(1.0, rgb), decode_image),
        "camera_info": (bags.camera_info(1.0, camera), decode_camera),
        "pose": (bags.pose_with_covariance(1.0, np.eye(4), np.eye(6)), lambda message: decode_pose(message, "prior")),
    }
    for name, (message, take) in samples.items():
        kind = message.__msgtype__
        found[f"message {name}"] = Target([bytes(_TYPES.serialize_cdr(message, kind))], _read_message(kind, take))
    return found


def _read_message(kind: str, take: Callable[[Any], Any]) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                message = _TYPES.deserialize_cdr(path.read_bytes(), kind)
        except Exception as error:  # rosbags' own: no message comes of it
            raise ValueError("no message") from error
        return take(message)

    return read


def _bags(folder: Path) -> dict[str, Target]:
    found = {}
    messages = [("/image", bags.image(1.0 + number, np.zeros((6, 8, 3), np.uint8))) for number in range(3)]
    for plugin in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
        path = folder / f"bag_{plugin.name}"
        bags.write_messages(path, messages, plugin)
        for file in sorted(path.iterdir()):
            found[f"bag {plugin.name.lower()} {file.suffix}"] = Target([file.read_bytes()], _read_bag(path, file))
    return found


def _read_bag(path: Path, file: Path) -> Callable[[Path], Any]:
    good = file.read_bytes()

    def read(changed: Path) -> Any:
        file.write_bytes(changed.read_bytes())
        try:
            with open_bag(path, {Role.IMAGE: "/image"}) as bag:
                return list(bag.messages())
        finally:
            file.write_bytes(good)

    return read


def mutated(rng: np.random.Generator, content: bytes) -> bytes:
    """Change an input: bits, numbers, runs of bytes, or its length; most changes are near the beginning."""
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 5))):
        if not changed:
            break
        reach = len(changed) if rng.random() < 0.4 else min(400, len(changed))
        place = int(rng.integers(reach))
        kind = rng.integers(6)
        if kind == 0:
            changed[place] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            changed[place] = int(rng.integers(256))
        elif kind == 2:
            number = int(rng.choice([0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF]))
            changed[place : place + 4] = struct.pack("<I", number)
        elif kind == 3:
            end = place + int(rng.integers(1, 64))
            changed[place:place] = changed[place:end] * int(rng.integers(1, 20))
        elif kind == 4:
            del changed[place : place + int(rng.integers(1, 64))]
        else:
            del changed[place:]
    return bytes(changed)
