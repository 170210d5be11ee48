"""What files and folders are that no reader here takes, and what to do with them."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

from gsfeatloc_ros.maps.gaussian_map import MapError

_SPLAT_TRANSFORM = "convert it to .ply or .sog with splat-transform (npm install -g @playcanvas/splat-transform)"
_SPARK = "export the .ply or .spz that it was made from (Spark's build-lod makes .rad of these)"
_GLTF = "convert it to .ply with 3dgs_io of the Autoware Foundation, or name the .ply that it was made from"
_USD = "it is not read: name the .ply that it was made from"
_CHECKPOINT = (
    "it is not read, as to read it may run code: export a .ply (nerfstudio: ns-export gaussian-splat; gsplat: "
    "simple_trainer.py --save-ply; INRIA: point_cloud/iteration_N/point_cloud.ply is beside it)"
)
_POINTS = "is a point cloud, without Gaussians: train a Gaussian splatting map, and name its file"
_MESH = "is a mesh, without Gaussians: train a Gaussian splatting map, and name its file"
_UNPACK = "unpack it, and name the file in it"
_NO_MAP = "name a Gaussian splatting map"

# How files begin, from which byte on, and what they are.
_MAGICS: tuple[tuple[int, bytes, str], ...] = (
    (0, b"version https://git-lfs", "is a Git LFS pointer, not the file itself: fetch that with git lfs pull"),
    (0, b"RAD0", f"is a .rad of Spark: {_SPARK}"),
    (0, b"RADC", f"is a part of a .rad of Spark: {_SPARK}"),
    (0, b"glTF", f"is a glTF (.glb): {_GLTF}"),
    (0, b"PXR-USDC", f"is a USD file: {_USD}"),
    (0, b"#usda", f"is a USD file: {_USD}"),
    *(
        (0, bytes([0x80, protocol]), f"is a checkpoint or another pickle of Python: {_CHECKPOINT}")
        for protocol in range(2, 6)
    ),
    (0, b"\x93NUMPY", f"is an array of numpy: {_NO_MAP}"),
    (0, b"\x89HDF\r\n\x1a\n", f"is an HDF5 file: {_NO_MAP}"),
    (0, b"\x89PNG\r\n\x1a\n", f"is a PNG image: {_NO_MAP}, for gsplat's PngCompression the folder of the images"),
    (0, b"\xff\xd8\xff", f"is a JPEG image: {_NO_MAP}"),
    (0, b"RIFF", f"is a WebP image or another RIFF file: {_NO_MAP}, for an unbundled .sog its meta.json"),
    (0, b"GIF8", f"is a GIF image: {_NO_MAP}"),
    (0, b"II*\x00", f"is a TIFF image: {_NO_MAP}"),
    (0, b"MM\x00*", f"is a TIFF image: {_NO_MAP}"),
    (0, b"v/1\x01", f"is an OpenEXR image: {_NO_MAP}"),
    (4, b"ftyp", f"is a video or an image (MP4, HEIF): {_NO_MAP}"),
    (0, b"\x1aE\xdf\xa3", f"is a video (Matroska): {_NO_MAP}"),
    (0, b"LASF", _POINTS),
    (0, b"ASTM-E57", _POINTS),
    (0, b"# .PCD", _POINTS),
    (0, b"VERSION .7", _POINTS),
    (0, b"DRACO", f"is a mesh or point cloud compressed with Draco: {_NO_MAP}"),
    (0, b"Kaydara FBX", _MESH),
    (0, b"solid ", _MESH),
    (0, b"\x89MCAP0\r\n", f"is a recording (MCAP): {_NO_MAP}"),
    (0, b"#ROSBAG", f"is a recording (ROS 1): {_NO_MAP}"),
    (0, b"SQLite format 3", f"is a database or a recording (SQLite): {_NO_MAP}"),
    (0, b"PAR1", f"is a Parquet table: {_NO_MAP}"),
    (0, b"%PDF", f"is a PDF: {_NO_MAP}"),
    (0, b"\x7fELF", f"is a program: {_NO_MAP}"),
    (0, b"MZ", f"is a program: {_NO_MAP}"),
    (0, b"gsfeatloc_ros prepared map", "is the cache of a map: name the map beside it"),
    (0, b"gsfeatloc_ros view index", "is the index of a map: name the map beside it"),
    (0, b"<!DOCTYPE", "is a web page, not a map: was the download refused?"),
    (0, b"<html", "is a web page, not a map: was the download refused?"),
    (0, b"<?xml", f"is an XML file: {_NO_MAP}"),
    (0, b"7z\xbc\xaf'\x1c", f"is packed (7-Zip): {_UNPACK}"),
    (0, b"Rar!", f"is packed (RAR): {_UNPACK}"),
    (0, b"\xfd7zXZ", f"is packed (xz): {_UNPACK}"),
    (0, b"BZh", f"is packed (bzip2): {_UNPACK}"),
    (0, b"\x28\xb5\x2f\xfd", f"is packed (zstd): {_UNPACK}"),
    (257, b"ustar", f"is packed (tar): {_UNPACK}"),
)
HEAD_BYTES = 262
# Of a .ksplat the first bytes are a version of 0.1 or later and counts; it has no magic number.
_KSPLAT_HEADER_BYTES = 4096
# Of the list of files in a zip: of a .sog it takes 500.
_MAX_DIRECTORY_BYTES = 1 << 17


def refuse_foreign(path: Path, head: bytes) -> None:
    """Refuse a file of another kind by its name; `head` is its first HEAD_BYTES bytes."""
    for start, magic, what in _MAGICS:
        if head[start : start + len(magic)] == magic:
            raise MapError(f"{path}: {what}")
    if _is_ksplat(head, path.stat().st_size):
        raise MapError(f"{path}: is a .ksplat of GaussianSplats3D: {_SPLAT_TRANSFORM}")
    if head.isascii() and b"\0" not in head:
        raise MapError(f"{path}: is of no format that is read: it looks like a text")


def refuse_foreign_gzip(path: Path, head: bytes) -> None:
    """Refuse a gzip that is no .spz; `head` is what it begins with, unpacked."""
    kind = "a .ply" if head.startswith(b"ply") else "something that is no .spz"
    raise MapError(f"{path}: is packed (gzip), with {kind} in it: {_UNPACK} (gunzip --keep)")


def refuse_foreign_zip(path: Path) -> None:
    """Refuse a zip of another kind than a .sog by its name; raise what zipfile does for a damaged one."""
    _check_zip_directory(path)
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if "__MACOSX/" not in name]
    base_names = {name.rpartition("/")[2] for name in names}
    suffixes = {Path(name).suffix.lower() for name in names}
    if "lod-meta.json" in base_names:
        raise MapError(f"{path}: is packed (zip), with a streamed .sog in it: unpack it, and name its lod-meta.json")
    if "meta.json" in base_names:
        return
    if "data.pkl" in base_names:
        raise MapError(f"{path}: is a checkpoint of PyTorch: {_CHECKPOINT}")
    if suffixes & {".usd", ".usda", ".usdc"}:
        raise MapError(f"{path}: is a USD file (.usdz): {_USD}")
    if suffixes and suffixes <= {".npy"}:
        raise MapError(f"{path}: is an archive of numpy (.npz): {_NO_MAP}")
    if maps := [name for name in names if name.lower().endswith((".ply", ".spz", ".splat", ".sog", ".ksplat"))]:
        raise MapError(f"{path}: is packed (zip), with {maps[0]} in it: {_UNPACK}")
    raise MapError(f"{path}: is a zip without meta.json, so no .sog: {_NO_MAP}")


def _check_zip_directory(path: Path) -> None:
    """Refuse a zip of a million files: to list them takes hundreds of megabytes, and a minute."""
    with path.open("rb") as stream:
        # zipfile has no public call for what stands at the end of a zip; `ZipFile` would read the whole list.
        end = zipfile._EndRecData(stream)  # type: ignore[attr-defined]
    if end and end[zipfile._ECD_SIZE] > _MAX_DIRECTORY_BYTES:  # type: ignore[attr-defined]
        entries = end[zipfile._ECD_ENTRIES_TOTAL]  # type: ignore[attr-defined]
        size = end[zipfile._ECD_SIZE]  # type: ignore[attr-defined]
        raise MapError(f"{path}: is a zip of {entries} files in a list of {size} bytes, so no .sog: {_NO_MAP}")


def refuse_foreign_json(path: Path, content: Any) -> None:
    """Refuse a JSON file of another kind by its name."""
    keys = set(content) if isinstance(content, dict) else set()
    if {"asset", "meshes"} <= keys or "extensionsUsed" in keys:
        splats = "KHR_gaussian_splatting" in json.dumps(content.get("extensionsUsed", []))
        raise MapError(f"{path}: is a glTF{' with Gaussians' if splats else ''}: {_GLTF}")
    if {"splatType", "lodSplats", "lod_3dgs_info"} & keys:
        raise MapError(f"{path}: is an .lcc2 of XGRIDS: {_SPLAT_TRANSFORM}")
    if {"totalLevel", "cellLengthX"} & keys:
        raise MapError(f"{path}: is an .lcc of XGRIDS: {_SPLAT_TRANSFORM}")
    if "frames" in keys or "camera_path" in keys:
        raise MapError(f"{path}: tells the cameras of a scene (transforms.json), not its map: {_NO_MAP}")
    if not {"means", "scales"} & keys:
        raise MapError(f"{path}: is a JSON file that is no meta.json of a .sog: {_NO_MAP}")


def refuse_foreign_folder(path: Path) -> None:
    """Refuse a folder that holds no map that is found, and say what it is."""
    if (path / "config.yml").is_file() and (path / "nerfstudio_models").is_dir():
        raise MapError(
            f"{path}: is an output folder of nerfstudio: export a .ply (ns-export gaussian-splat --load-config "
            f"{path / 'config.yml'} --output-dir exports), and name that"
        )
    if (path / "ckpts").is_dir():
        raise MapError(f"{path}: is an output folder of gsplat: name the .ply in its folder ply (--save-ply)")
    for suffix, what in ((".lcc", ".lcc of XGRIDS"), (".lcc2", ".lcc2 of XGRIDS")):
        if any(path.glob(f"*{suffix}")):
            raise MapError(f"{path}: is the folder of an {what}: {_SPLAT_TRANSFORM}")
    raise MapError(
        f"{path}: is a folder without meta.json (unbundled .sog, gsplat's PngCompression), lod-meta.json (streamed "
        f".sog) or point_cloud/iteration_N/point_cloud.ply (INRIA's trainer): name the map's file"
    )


def _is_ksplat(head: bytes, size: int) -> bool:
    """Return whether a file of `size` bytes begins as a .ksplat does."""
    if size < _KSPLAT_HEADER_BYTES or len(head) < 64:
        return False
    numbers = [int.from_bytes(head[at : at + 4], "little") for at in range(4, 20, 4)]
    max_sections, sections, max_splats, splats = numbers
    return (
        head[0] == 0
        and 1 <= head[1] <= 9
        and head[2:4] == b"\0\0"
        and 1 <= sections <= max_sections
        and 1 <= splats <= max_splats
        and int.from_bytes(head[20:22], "little") <= 2
    )
