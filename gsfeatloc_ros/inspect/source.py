"""Of which format a map's file is, and which program wrote it, as far as it says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsfeatloc_ros.common.json_file import read_json
from gsfeatloc_ros.common.words import shortened
from gsfeatloc_ros.maps.files import find_map
from gsfeatloc_ros.maps.ply_file import PlyFile
from gsfeatloc_ros.maps.sog import read_meta

_UNKNOWN = "not said in the file"
_MAX_PRODUCER = 200


@dataclass(frozen=True)
class Source:
    """A map's file.

    Attributes:
        path: of the file that is read.
        format: its format.
        producer: which program wrote it, in the file's words.
        megabytes: its size.
    """

    path: str
    format: str
    producer: str
    megabytes: float


def read_source(path: Path) -> Source:
    """Return what a file says of itself; it is one that load_map has read."""
    found = find_map(path)
    with found.open("rb") as stream:
        head = stream.read(16)
    format_, producer = _told(found, head)
    return Source(str(found), format_, shortened(producer, _MAX_PRODUCER), found.stat().st_size / 1e6)


def _told(path: Path, head: bytes) -> tuple[str, str]:
    if head.startswith(b"ply"):
        ply = PlyFile(path)
        kind = "compressed .ply of PlayCanvas" if "packed_position" in ply["vertex"] else ".ply"
        return kind, "; ".join(ply.comments) or _UNKNOWN
    if head.startswith(b"NGSP"):
        return f".spz, version {int.from_bytes(head[4:8], 'little')}", _UNKNOWN
    if head.startswith(b"\x1f\x8b"):
        return ".spz", _UNKNOWN
    if head.startswith(b"PK"):
        return ".sog", _generator(read_meta(path))
    if head.startswith(b"{"):
        meta = read_json(path)
        kind = "streamed .sog" if "lodLevels" in meta else "folder of images (unbundled .sog, or gsplat's PNG)"
        return kind, _generator(meta)
    return ".splat", _UNKNOWN


def _generator(meta: Any) -> str:
    """Return who made a .sog, as its meta.json says it."""
    asset = meta.get("asset") if isinstance(meta, dict) else None
    return str(asset.get("generator", _UNKNOWN)) if isinstance(asset, dict) else _UNKNOWN
