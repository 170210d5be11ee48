"""The Gaussian Splatting map of a simulated room."""

from __future__ import annotations

import cv2
import numpy as np

from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.simulate.room import Room, grid_uv

# The spherical harmonic of degree 0: colour = 0.5 + _SH_0 * coefficient.
_SH_0 = 0.28209479177387814
_THICKNESS = 0.001
_OPACITY = 0.97
# Standard deviation of a disc over the distance to its neighbours. Small discs keep the picture sharp and the depth
# right and leave holes between them, which a coarse layer deeper in the solid fills: so deep that its discs come
# behind those of the surface from grazing views too.
_SPREAD = 0.45
_BACKING_SPREAD = 0.6
_BACKING_SPACING = 2.0
_BACKING_DEPTH = 0.05
# How much of what the discs blur away is added to their colours beforehand.
_SHARPEN = 0.8


def cover(room: Room, spacing: float = 0.028) -> GaussianMap:
    """Cover the surfaces of the room with flat Gaussians, one every `spacing` metres, wherever they can be seen."""
    front = _layer(room, spacing, _SPREAD, depth=0.0)
    backing = _layer(room, _BACKING_SPACING * spacing, _BACKING_SPREAD, _BACKING_DEPTH)
    means, normals, widths, colours = (np.concatenate(parts) for parts in zip(front, backing, strict=True))
    return GaussianMap(
        means=means.astype(np.float32),
        scales=np.column_stack([widths, widths, np.full(len(widths), _THICKNESS)]).astype(np.float32),
        rotations=_turning_z_to(normals).astype(np.float32),
        opacities=np.full(len(means), _OPACITY, np.float32),
        sh=((colours - 0.5) / _SH_0).astype(np.float32)[:, None],
    )


def _layer(room: Room, spacing: float, spread: float, depth: float) -> tuple[np.ndarray, ...]:
    """Return discs `depth` metres under the surfaces: centres (N, 3), normals (N, 3), widths (N,), colours (N, 3)."""
    means, normals, widths, colours = [], [], [], []
    for index, solid in enumerate(room.solids):
        # The walls, the first of the solids, are seen from inside.
        side = -1 if index == 0 else 1
        layer = solid.grown(-side * depth)
        for face, picture in enumerate(room.pictures[index]):
            size = solid.face_size(face)
            cols, rows = np.ceil(size / spacing).astype(int)
            uv = grid_uv(rows, cols)
            surface, outward = solid.face_points(face, uv)
            seen = room.is_free(surface + 0.02 * side * outward, margin=0.01)
            means.append(layer.face_points(face, uv)[0][seen])
            normals.append(outward[seen])
            widths.append(np.full(seen.sum(), spread * max(size[0] / cols, size[1] / rows)))
            colours.append(_sharpened(picture, rows, cols, spread).reshape(-1, 3)[seen])
    return tuple(np.concatenate(parts) for parts in (means, normals, widths, colours))


def _sharpened(picture: np.ndarray, rows: int, cols: int, spread: float) -> np.ndarray:
    """Return colours (rows, cols, 3) in [0, 1] of the discs of a face."""
    colours = cv2.resize(picture, (int(cols), int(rows)), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    return np.clip(colours + _SHARPEN * (colours - cv2.GaussianBlur(colours, (0, 0), spread)), 0, 1)


def _turning_z_to(normals: np.ndarray) -> np.ndarray:
    """Return unit quaternions wxyz (N, 4) of the shortest rotations that turn the z axis into unit vectors (N, 3)."""
    x, y, z = normals.T
    quaternions = np.column_stack([1 + z, -y, x, np.zeros(len(z))])
    # Straight down, there is no shortest one: any half turn does.
    quaternions[z < -1 + 1e-9] = [0, 1, 0, 0]
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
