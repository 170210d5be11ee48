"""Maps in the .ply layout of the INRIA trainer, gsplat and nerfstudio, and what others add to it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from gsfeatloc_ros.maps import compressed_ply
from gsfeatloc_ros.maps.assemble import SH_C0, Block, Gather, Layout, T, check_count, single_precision_step
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap, MapError
from gsfeatloc_ros.maps.options import ReadOptions
from gsfeatloc_ros.maps.ply_file import PlyFile, check_no_lists, columns

_MEANS = ["x", "y", "z"]
_NORMALS = ["nx", "ny", "nz"]
_SH_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_RGB = ["red", "green", "blue"]
_OPACITY = ["opacity"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_ROTATIONS = ["rot_0", "rot_1", "rot_2", "rot_3"]
# Of Mip-Splatting and Gaussian Opacity Fields: how wide, in splat units, a Gaussian is at least to be drawn.
_FILTER = "filter_3D"

# Properties that only maps of other primitives have, by name or, with a _ at the end, by how they begin.
_OTHER_PRIMITIVES = {
    "f_offset_": "a Scaffold-GS or Octree-GS map, whose Gaussians are made by networks that are not in it",
    "f_anchor_feat_": "a Scaffold-GS or Octree-GS map, whose Gaussians are made by networks that are not in it",
    "trbf_": "a map of moving Gaussians (Spacetime Gaussians)",
    "motion_": "a map of moving Gaussians (Spacetime Gaussians)",
    "omega_": "a map of moving Gaussians (Spacetime Gaussians)",
    "scale_t": "a map of 4D Gaussians",
    "rot_r_": "a map of 4D Gaussians",
    "beta": "a Deformable Beta Splatting map",
    "shape": "a GES map, of generalized exponentials",
    "nu_degree": "a Student-t splatting map",
}
_EXPORT = "export it as 3D Gaussians, in the layout of the INRIA trainer"
# Keeps the logit of an opacity finite when it is written.
_MIN_OPACITY = 1e-7


def read_ply(path: Path, options: ReadOptions, gather: Gather[T]) -> T:
    """Read a map from a .ply file: ascii or binary, float or double, properties in any order, of any SH degree.

    PlayCanvas's compressed .ply is read as well.

    Raises:
        MapError: the file is no .ply, truncated, of another layout, empty or holds too many invalid values.
        OSError: it cannot be read.
    """
    ply = PlyFile(path)
    if "vertex" not in ply:
        raise MapError(f"{path}: has no element 'vertex', so no Gaussians")
    vertex = ply["vertex"]
    check_no_lists(ply, vertex)
    check_count(path, vertex.count)
    compressed = "packed_position" in vertex
    coefficients = compressed_ply.check_layout(ply) if compressed else _check_layout(ply)
    used = min(coefficients, SH_COEFFICIENTS[-1])
    unused = [] if compressed else _unused(ply, coefficients)
    layout = Layout(vertex.count, used, _antialiased(ply), tuple(unused + _remarks(ply, compressed)))
    blocks = compressed_ply.blocks(ply, coefficients) if compressed else _blocks(ply, coefficients)
    return gather(path, layout, blocks, options)


def write_ply(path: str | Path, gaussian_map: GaussianMap) -> None:
    """Write a map as a binary .ply in the INRIA layout; opacities are kept 1e-7 away from 0 and 1.

    The file has no place for S_map_splat, so that is not written.
    """
    write_ply_parts(path, [gaussian_map], len(gaussian_map))


def write_ply_parts(path: str | Path, parts: Iterable[GaussianMap], count: int) -> None:
    """Write the parts of a map, one after another, which are of `count` Gaussians together and all alike."""
    with Path(path).open("wb") as stream:
        for number, part in enumerate(parts):
            vertices = _vertices(part)
            if number == 0:
                comments = ["SplatRenderMode: mip"] if part.antialiased else []
                ply = PlyData([PlyElement.describe(vertices[:0], "vertex")], byte_order="<", comments=comments)
                stream.write(ply.header.replace("element vertex 0", f"element vertex {count}").encode() + b"\n")
            vertices.tofile(stream)


def _vertices(gaussian_map: GaussianMap) -> np.ndarray:
    """Return the rows of a file (N,), a field for each property."""
    opacities = np.clip(gaussian_map.opacities.astype(np.float64), _MIN_OPACITY, 1.0 - _MIN_OPACITY)
    # The file holds all harmonics of red, then of green, then of blue.
    rest = gaussian_map.sh[:, 1:].transpose(0, 2, 1).reshape(len(gaussian_map), 3 * gaussian_map.sh.shape[1] - 3)
    groups = [
        (_MEANS, gaussian_map.means),
        (_NORMALS, np.zeros_like(gaussian_map.means)),
        (_SH_DC, gaussian_map.sh[:, 0]),
        ([f"f_rest_{index}" for index in range(rest.shape[1])], rest),
        (_OPACITY, np.log(opacities / (1.0 - opacities))[:, None]),
        (_SCALES, np.log(gaussian_map.scales)),
        (_ROTATIONS, gaussian_map.rotations),
    ]
    vertices = np.empty(len(gaussian_map), dtype=[(name, "<f4") for names, _ in groups for name in names])
    for names, values in groups:
        for name, column in zip(names, values.T, strict=True):
            vertices[name] = column
    return vertices


def _antialiased(ply: PlyFile) -> bool | None:
    """Return whether a comment of Brush or Postshot says that the map was trained antialiased; the last one counts."""
    antialiased: bool | None = None
    for comment in ply.comments:
        match comment.lower().split():
            case ["splatrendermode:", "2dgs"]:
                raise MapError(f"{ply.path}: is a 2D Gaussian splatting (2DGS) map; only 3D ones are read")
            case ["splatrendermode:", ("mip" | "default") as mode]:
                antialiased = mode == "mip"
            case ["splatrendermode:", *mode]:
                raise MapError(f"{ply.path}: is to be rendered in a mode that is not known: {' '.join(mode)}")
            case ["antialiased", ("0" | "1") as flag]:
                antialiased = flag == "1"
            case [("postshot.anti_aliasing=0" | "postshot.anti_aliasing=1") as flag]:
                antialiased = flag.endswith("1")
    return antialiased


def _remarks(ply: PlyFile, compressed: bool) -> list[str]:
    """Return what there is to say of a header beyond the properties of its Gaussians."""
    known = {"vertex", "chunk", "sh"} if compressed else {"vertex"}
    notes = []
    if others := [name for name in ply.elements if name not in known]:
        notes.append(f"elements that are not used: {', '.join(others)}")
    if ply.trailing_bytes:
        notes.append(f"{ply.trailing_bytes} bytes behind the data are not used")
    for comment in ply.comments:
        # Brush writes where up is in the data; the Gaussians stay in the frame of their photos.
        if comment.lower().startswith("vertical axis:"):
            notes.append(f"the file says {comment!r}: turn it by map.rotation if the robot's up is another")
    return notes


def _unused(ply: PlyFile, coefficients: int) -> list[str]:
    """Return what there is to say of properties that are not those of the INRIA layout."""
    vertex = ply["vertex"]
    known = {*_MEANS, *_NORMALS, *_SH_DC, *_OPACITY, *_SCALES, *_ROTATIONS, _FILTER}
    known |= set() if _SH_DC[0] in vertex else set(_RGB)
    names = [p.name for p in vertex.properties if p.name not in known and not p.name.startswith("f_rest_")]
    notes = [f"properties that are not used: {', '.join(names)}"] if names else []
    if _FILTER in vertex:
        notes.append(f"{_FILTER} of Mip-Splatting or GOF is taken into scales and opacities")
    if _SH_DC[0] not in vertex:
        notes.append("colours are RGB, the same from all sides")
    if coefficients > SH_COEFFICIENTS[-1]:
        notes.append(f"spherical harmonics of degree {math.isqrt(coefficients) - 1} are read to degree 3")
    return notes


def _check_layout(ply: PlyFile) -> int:
    """Refuse a header that is not that of a Gaussian splatting map; return its SH coefficients per channel."""
    vertex = ply["vertex"]
    _check_primitives(ply)
    colors = _SH_DC if _SH_DC[0] in vertex or not _is_rgb(vertex) else _RGB
    missing = [name for name in [*_MEANS, *colors, *_OPACITY, *_SCALES, *_ROTATIONS] if name not in vertex]
    if missing == _SH_DC and _RGB[0] in vertex:
        raise MapError(f"{ply.path}: has colours that are no bytes: export them as spherical harmonics or 8-bit RGB")
    if missing:
        raise MapError(f"{ply.path}: lacks {', '.join(missing)} of a Gaussian splatting map")
    rest = {p.name for p in vertex.properties if p.name.startswith("f_rest_")}
    coefficients = 1 + len(rest) // 3
    if (
        math.isqrt(coefficients) ** 2 != coefficients
        or rest != {f"f_rest_{index}" for index in range(3 * (coefficients - 1))}
        or (rest and colors is _RGB)
    ):
        raise MapError(
            f"{ply.path}: has {len(rest)} f_rest properties; spherical harmonics of degree 0 to 4 have f_dc_0 to "
            f"f_dc_2 and f_rest_0 up to a number of 0, 9, 24, 45 or 72"
        )
    return coefficients


def _check_primitives(ply: PlyFile) -> None:
    """Refuse by its name what is no 3D Gaussian splatting map."""
    names = [p.name for p in ply["vertex"].properties]
    for other, what in _OTHER_PRIMITIVES.items():
        if any(name == other or (other.endswith("_") and name.startswith(other)) for name in names):
            raise MapError(f"{ply.path}: is {what}: {_EXPORT}")
    if "scale_1" in names and "scale_2" not in names:
        raise MapError(f"{ply.path}: has no scale_2: this is a 2D Gaussian splatting (2DGS) map; only 3D ones are read")
    if "scalar_opacity" in names or "scalar_scale_0" in names:
        raise MapError(
            f"{ply.path}: was saved by CloudCompare, which renames the properties of Gaussians to scalar_... and does "
            f"not turn or scale them with the points: crop and move the map with SuperSplat or splat-transform"
        )
    if not {*_OPACITY, *_SCALES, *_ROTATIONS} & set(names):
        kind = "mesh" if "face" in ply.elements else "point cloud"
        raise MapError(f"{ply.path}: is a {kind} without Gaussians: train a Gaussian splatting map, and name its .ply")


def _is_rgb(vertex: PlyElement) -> bool:
    """Return whether the vertices have colours as bytes."""
    return all(name in vertex and np.dtype(vertex.dtype())[name] == np.uint8 for name in _RGB)


def _blocks(ply: PlyFile, coefficients: int) -> Iterator[Block]:
    """Yield runs of Gaussians, activated: exp of log scales, sigmoid of opacity logits."""
    vertex = ply["vertex"]
    # The file holds all harmonics of red, then of green, then of blue.
    count = coefficients - 1
    used = min(coefficients, SH_COEFFICIENTS[-1]) - 1
    rest = [f"f_rest_{channel * count + index}" for index in range(used) for channel in range(3)]
    double = all(np.dtype(vertex.dtype())[name] == np.float64 for name in _MEANS)
    for rows in ply.blocks("vertex"):
        means = columns(rows, _MEANS, np.float64 if double else np.float32)
        if _SH_DC[0] in vertex:
            sh = columns(rows, [*_SH_DC, *rest])
        else:
            sh = (columns(rows, _RGB) / np.float32(255.0) - np.float32(0.5)) / np.float32(SH_C0)
        scales, opacities = _activated(rows, _FILTER in vertex)
        yield Block(
            means=means,
            scales=scales,
            rotations=columns(rows, _ROTATIONS),
            opacities=opacities,
            sh=sh.reshape(len(rows), -1, 3),
            step=0.0 if double else single_precision_step(means),
        )


def _activated(rows: np.ndarray, filtered: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return scales (n, 3) and opacities (n,); a logarithm or logit of minus infinity gives 0, a logit of infinity 1.

    With the filter, as Mip-Splatting draws them (Yu et al., 2024, eq. 7): a Gaussian is wider, and dimmed as much.
    """
    scales = np.exp(columns(rows, _SCALES))
    opacities = 1.0 / (1.0 + np.exp(-columns(rows, _OPACITY)[:, 0]))
    if not filtered:
        return scales, opacities
    # In double precision: the product of three squares of small scales is less than float32 can say.
    squares = scales.astype(np.float64) ** 2
    wider = squares + columns(rows, [_FILTER]).astype(np.float64) ** 2
    shares = np.divide(squares, wider, out=np.ones_like(wider), where=wider != 0)
    return np.sqrt(wider), opacities * np.sqrt(np.prod(shares, axis=1))
