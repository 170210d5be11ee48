"""Maps in the .ply layout of the INRIA trainer, gsplat and nerfstudio."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap, MapError

_MEANS = ["x", "y", "z"]
_NORMALS = ["nx", "ny", "nz"]
_SH_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_OPACITY = ["opacity"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_ROTATIONS = ["rot_0", "rot_1", "rot_2", "rot_3"]

# A header of 62 properties takes 1.5 KB; the rest is room for comments.
_MAX_HEADER_BYTES = 64 * 1024
# Rows read at once: a block of them stays in the CPU's cache while it is taken apart into columns.
_BLOCK = 8192
# Keeps the logit of an opacity finite when it is written.
_MIN_OPACITY = 1e-7


def read_ply(path: Path) -> GaussianMap:
    """Read a map from a .ply file: ascii or binary, float or double, properties in any order, SH degree 0 to 3.

    The numbers that the header declares are checked against the file's size before any memory is taken for them.

    Raises:
        MapError: the file is missing, not a .ply, truncated, of another layout, empty or holds invalid values.
    """
    try:
        if path.exists() and not path.is_file():  # opening a pipe would wait for its writer
            raise MapError(f"{path}: is not a file")
        with path.open("rb") as stream:
            head = io.BytesIO(stream.read(_MAX_HEADER_BYTES))
        file_size = path.stat().st_size
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {error.strerror}") from error
    header = _parse_header(path, head)
    rest_count = _check_layout(path, header)
    _check_size(path, header, file_size - head.tell())
    vertices = _read_ascii(path) if header.text else _map_binary(path, header, head.tell())
    return _activate(path, vertices, rest_count)


def write_ply(path: str | Path, gaussian_map: GaussianMap) -> None:
    """Write a map as a binary .ply in the INRIA layout; opacities are kept 1e-7 away from 0 and 1."""
    opacities = np.clip(gaussian_map.opacities.astype(np.float64), _MIN_OPACITY, 1.0 - _MIN_OPACITY)
    # The file holds all harmonics of red, then of green, then of blue.
    rest = gaussian_map.sh[:, 1:].transpose(0, 2, 1).reshape(len(gaussian_map), -1)
    groups = [
        (_MEANS, gaussian_map.means),
        (_NORMALS, np.zeros_like(gaussian_map.means)),
        (_SH_DC, gaussian_map.sh[:, 0]),
        (_rest_names(rest.shape[1]), rest),
        (_OPACITY, np.log(opacities / (1.0 - opacities))[:, None]),
        (_SCALES, np.log(gaussian_map.scales)),
        (_ROTATIONS, gaussian_map.rotations),
    ]
    vertices = np.empty(len(gaussian_map), dtype=[(name, "<f4") for names, _ in groups for name in names])
    for names, columns in groups:
        for name, column in zip(names, columns.T, strict=True):
            vertices[name] = column
    PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(path))


def _parse_header(path: Path, head: io.BytesIO) -> PlyData:
    """Parse the header and leave `head` at the first byte of the data."""
    if not head.getvalue().startswith(b"ply"):
        raise MapError(f"{path}: is not a .ply file" if head.getvalue() else f"{path}: is an empty file")
    try:
        # plyfile has no public call for the header alone; `PlyData.read` would take the memory that it declares.
        return PlyData._parse_header(head)
    except (PlyParseError, ValueError) as error:
        raise MapError(f"{path}: has no valid .ply header: {error}") from error


def _check_layout(path: Path, header: PlyData) -> int:
    """Refuse a header that is not that of a Gaussian splatting map; return the number of its f_rest properties."""
    if "vertex" not in header:
        raise MapError(f"{path}: has no element 'vertex', so no Gaussians")
    vertex = header["vertex"]
    if "packed_position" in vertex:
        raise MapError(f"{path}: is a PlayCanvas compressed .ply, which is not read yet: export it uncompressed")
    lists = [p.name for p in vertex.properties if isinstance(p, PlyListProperty)]
    if lists:
        raise MapError(f"{path}: element 'vertex' has list properties ({', '.join(lists)}); a map has none")
    required = _MEANS + _SH_DC + _OPACITY + _SCALES + _ROTATIONS
    missing = [name for name in required if name not in vertex]
    if missing == ["scale_2"]:
        raise MapError(f"{path}: has no scale_2: this is a 2D Gaussian splatting (2DGS) map; only 3D ones are read")
    if missing:
        hint = ": is it a mesh or a point cloud?" if "opacity" in missing else ""
        raise MapError(f"{path}: lacks {', '.join(missing)} of a Gaussian splatting map{hint}")
    rest = {p.name for p in vertex.properties if p.name.startswith("f_rest_")}
    counts = [3 * (coefficients - 1) for coefficients in SH_COEFFICIENTS]
    if len(rest) not in counts or rest != set(_rest_names(len(rest))):
        raise MapError(
            f"{path}: has {len(rest)} f_rest properties; spherical harmonics of degree 0 to 3 take f_rest_0 up to "
            f"a number of {', '.join(map(str, counts[:-1]))} or {counts[-1]}"
        )
    return len(rest)


def _check_size(path: Path, header: PlyData, data_size: int) -> None:
    """Refuse counts that do not fit the `data_size` bytes after the header."""
    if any(element.count < 0 for element in header):
        raise MapError(f"{path}: declares a negative number of elements")
    if header["vertex"].count == 0:
        raise MapError(f"{path}: holds no Gaussians (element 'vertex' 0)")
    if header.text:
        # Each value takes a digit and a separator; the last separator of the file may be missing.
        declared = sum(element.count * 2 * max(1, len(element.properties)) for element in header) - 1
        exact = False
    else:
        fixed = [e for e in header if not any(isinstance(p, PlyListProperty) for p in e.properties)]
        declared = sum(element.count * element.dtype(header.byte_order).itemsize for element in fixed)
        exact = len(fixed) == len(header)
    if data_size < declared:
        raise MapError(f"{path}: is truncated: the header declares {declared} bytes of data, the file has {data_size}")
    if exact and data_size > declared:
        raise MapError(f"{path}: is damaged: the header declares {declared} bytes of data, the file has {data_size}")


def _map_binary(path: Path, header: PlyData, offset: int) -> np.ndarray:
    """Map the rows of element 'vertex' (N,) of a binary file into memory; `offset` is where the data begin."""
    vertex = header["vertex"]
    for element in header.elements[: header.elements.index(vertex)]:
        dtype = element.dtype(header.byte_order)
        if dtype.hasobject:
            raise MapError(f"{path}: has list properties in element '{element.name}' before 'vertex'")
        offset += element.count * dtype.itemsize
    return np.memmap(path, dtype=vertex.dtype(header.byte_order), mode="r", offset=offset, shape=(vertex.count,))


def _read_ascii(path: Path) -> np.ndarray:
    try:
        return PlyData.read(str(path))["vertex"].data
    except (PlyParseError, ValueError) as error:
        raise MapError(f"{path}: is damaged: {error}") from error


def _activate(path: Path, vertices: np.ndarray, rest_count: int) -> GaussianMap:
    """Turn stored values into parameters: exp of log scales, sigmoid of opacity logits, unit quaternions."""
    means = _columns(vertices, _MEANS)
    scales = _columns(vertices, _SCALES)
    rotations = _columns(vertices, _ROTATIONS)
    opacities = _columns(vertices, _OPACITY)[:, 0]
    # The file holds all harmonics of red, then of green, then of blue.
    rest_names = np.array(_rest_names(rest_count), dtype=object).reshape(3, -1).T.ravel()
    sh = _columns(vertices, [*_SH_DC, *rest_names])

    invalid = np.zeros(len(vertices), dtype=bool)
    for values in (means, scales, rotations, opacities[:, None], sh):
        invalid |= ~np.isfinite(values).all(axis=1)
    with np.errstate(over="ignore"):
        np.exp(scales, out=scales)
        opacities = 1.0 / (1.0 + np.exp(-opacities))
    invalid |= ~np.isfinite(scales).all(axis=1)
    if invalid.any():
        raise MapError(
            f"{path}: {invalid.sum()} of {len(vertices)} Gaussians have values that are NaN, infinite or too large, "
            f"the first is number {invalid.argmax()}"
        )
    # A Gaussian may be flatter than float32 can say, never of no extent.
    np.maximum(scales, np.finfo(np.float32).tiny, out=scales)

    norms = np.linalg.norm(rotations.astype(np.float64), axis=1)
    if not norms.all():
        raise MapError(
            f"{path}: {np.count_nonzero(norms == 0)} of {len(vertices)} Gaussians have a rotation quaternion of "
            f"zero length, the first is number {norms.argmin()}"
        )
    return GaussianMap(
        means=means,
        scales=scales,
        rotations=(rotations / norms[:, None]).astype(np.float32),
        opacities=opacities,
        sh=sh.reshape(len(vertices), -1, 3),
    )


def _columns(vertices: np.ndarray, names: list[str]) -> np.ndarray:
    """Copy the named fields of the rows `vertices` (N,) into an array (N, len(names)) float32."""
    columns = np.empty((len(vertices), len(names)), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # what does not fit becomes infinite and is refused by its value
        for start in range(0, len(vertices), _BLOCK):
            block = slice(start, start + _BLOCK)
            for index, name in enumerate(names):
                columns[block, index] = vertices[name][block]
    return columns


def _rest_names(count: int) -> list[str]:
    return [f"f_rest_{index}" for index in range(count)]
