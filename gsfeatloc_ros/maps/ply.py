"""Maps in the .ply layout of the INRIA trainer, gsplat and nerfstudio."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from gsfeatloc_ros.maps import compressed_ply
from gsfeatloc_ros.maps.assemble import Block, assemble, check_count
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap, MapError
from gsfeatloc_ros.maps.ply_file import PlyFile, check_no_lists, columns

_MEANS = ["x", "y", "z"]
_NORMALS = ["nx", "ny", "nz"]
_SH_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_OPACITY = ["opacity"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_ROTATIONS = ["rot_0", "rot_1", "rot_2", "rot_3"]

# Keeps the logit of an opacity finite when it is written.
_MIN_OPACITY = 1e-7


def read_ply(path: Path) -> GaussianMap:
    """Read a map from a .ply file: ascii or binary, float or double, properties in any order, SH degree 0 to 3.

    PlayCanvas's compressed .ply is read as well.

    Raises:
        MapError: the file is no .ply, truncated, of another layout, empty or holds invalid values.
        OSError: it cannot be read.
    """
    ply = PlyFile(path)
    if "vertex" not in ply:
        raise MapError(f"{path}: has no element 'vertex', so no Gaussians")
    antialiased = _antialiased(ply)
    vertex = ply["vertex"]
    check_no_lists(ply, vertex)
    check_count(path, vertex.count)
    if "packed_position" in vertex:
        coefficients = compressed_ply.check_layout(ply)
        return assemble(path, vertex.count, coefficients, compressed_ply.blocks(ply, coefficients), antialiased)
    coefficients = _check_layout(ply)
    return assemble(path, vertex.count, coefficients, _blocks(ply, coefficients), antialiased)


def write_ply(path: str | Path, gaussian_map: GaussianMap) -> None:
    """Write a map as a binary .ply in the INRIA layout; opacities are kept 1e-7 away from 0 and 1.

    The file has no place for S_map_splat, so that is not written.
    """
    opacities = np.clip(gaussian_map.opacities.astype(np.float64), _MIN_OPACITY, 1.0 - _MIN_OPACITY)
    # The file holds all harmonics of red, then of green, then of blue.
    rest = gaussian_map.sh[:, 1:].transpose(0, 2, 1).reshape(len(gaussian_map), -1)
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
    comments = ["SplatRenderMode: mip"] if gaussian_map.antialiased else []
    PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<", comments=comments).write(str(path))


def _antialiased(ply: PlyFile) -> bool:
    """Return whether a comment of Brush or Postshot says that the map was trained antialiased; the last one counts."""
    antialiased = False
    for comment in ply.comments:
        match comment.lower().split():
            case ["splatrendermode:", "2dgs"]:
                raise MapError(f"{ply.path}: is a 2D Gaussian splatting (2DGS) map; only 3D ones are read")
            case ["splatrendermode:", ("mip" | "default") as mode]:
                antialiased = mode == "mip"
            case ["antialiased", ("0" | "1") as flag]:
                antialiased = flag == "1"
            case [("postshot.anti_aliasing=0" | "postshot.anti_aliasing=1") as flag]:
                antialiased = flag.endswith("1")
    return antialiased


def _check_layout(ply: PlyFile) -> int:
    """Refuse a header that is not that of a Gaussian splatting map; return its SH coefficients per channel."""
    vertex = ply["vertex"]
    required = _MEANS + _SH_DC + _OPACITY + _SCALES + _ROTATIONS
    missing = [name for name in required if name not in vertex]
    if missing == ["scale_2"]:
        raise MapError(f"{ply.path}: has no scale_2: this is a 2D Gaussian splatting (2DGS) map; only 3D ones are read")
    if missing == _SH_DC:
        raise MapError(f"{ply.path}: lacks {', '.join(missing)}: export the colours as spherical harmonics, not as RGB")
    if missing:
        hint = ": is it a mesh or a point cloud?" if "opacity" in missing else ""
        raise MapError(f"{ply.path}: lacks {', '.join(missing)} of a Gaussian splatting map{hint}")
    rest = {p.name for p in vertex.properties if p.name.startswith("f_rest_")}
    coefficients = 1 + len(rest) // 3
    if coefficients not in SH_COEFFICIENTS or rest != {f"f_rest_{index}" for index in range(3 * (coefficients - 1))}:
        raise MapError(
            f"{ply.path}: has {len(rest)} f_rest properties; spherical harmonics of degree 0 to 3 take f_rest_0 up to "
            f"a number of 0, 9, 24 or 45"
        )
    return coefficients


def _blocks(ply: PlyFile, coefficients: int) -> Iterator[Block]:
    """Yield runs of Gaussians, activated: exp of log scales, sigmoid of opacity logits."""
    # The file holds all harmonics of red, then of green, then of blue.
    count = coefficients - 1
    rest = [f"f_rest_{channel * count + index}" for index in range(count) for channel in range(3)]
    for rows in ply.blocks("vertex"):
        yield Block(
            means=columns(rows, _MEANS),
            scales=np.exp(_nan_if_infinite(columns(rows, _SCALES))),
            rotations=columns(rows, _ROTATIONS),
            opacities=1.0 / (1.0 + np.exp(-_nan_if_infinite(columns(rows, _OPACITY)[:, 0]))),
            sh=columns(rows, [*_SH_DC, *rest]).reshape(len(rows), -1, 3),
        )


def _nan_if_infinite(values: np.ndarray) -> np.ndarray:
    """Return the values, with NaN for the infinite ones, which would become 0 or 1 and pass for valid."""
    return np.where(np.isfinite(values), values, np.float32(np.nan))
