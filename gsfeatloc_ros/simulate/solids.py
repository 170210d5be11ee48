"""Solids with closed-form ray intersections, their surfaces laid out on the six faces of a cube.

A surface point is given by its face (0 to 5: -x +x -y +y -z +z of the solid's own axes) and its position (u, v) in
[-1, 1]^2 on that face. A sphere uses the equiangular cube map, which keeps the scale nearly even.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsfeatloc_ros.common.geometry import so3_exp

# The axes along which u and v of a face run, by the axis of its normal.
_FACE_AXES = np.array([[1, 2], [0, 2], [0, 1]])


@dataclass(frozen=True, eq=False)
class Box:
    """A box turned by `yaw` radians about the vertical.

    Attributes:
        centre: (3,) metres, map frame.
        size: (3,) metres along its own axes.
        yaw: radians about z.
    """

    centre: np.ndarray
    size: np.ndarray
    yaw: float = 0.0
    R_map_solid: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "R_map_solid", so3_exp(np.array([0.0, 0.0, self.yaw])))

    @property
    def radius(self) -> float:
        """Return the radius of the sphere around the centre that holds the solid."""
        return 0.5 * float(np.linalg.norm(self.size))

    def intersect(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the smallest t > 0 (N,) where `origin + t * directions` (N, 3) meets the surface; inf if none.

        By slabs (Kay and Kajiya, 1986). From inside, the ray meets the surface where it leaves.
        """
        start = ((origin - self.centre) @ self.R_map_solid).astype(directions.dtype)
        local = rotate(self.R_map_solid.T, directions)
        half = (0.5 * self.size).astype(directions.dtype)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            low, high = (-half - start) / local, (half - start) / local
        # fmax and fmin: a ray that runs in a slab's border plane gives 0 / 0 there, which says nothing about it.
        enter: np.ndarray = np.fmax.reduce(np.minimum(low, high), axis=1)
        leave: np.ndarray = np.fmin.reduce(np.maximum(low, high), axis=1)
        t = np.where(enter > 0, enter, leave)
        return np.where((enter <= leave) & (t > 0), t, np.inf)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance (N,) of points (N, 3) from the surface, negative inside (less outside corners)."""
        return (np.abs((points - self.centre) @ self.R_map_solid) - 0.5 * self.size).max(axis=1)

    def grown(self, margin: float) -> Box:
        """Return the box with every face moved outwards by `margin` metres."""
        return Box(self.centre, self.size + 2 * margin, self.yaw)

    def face_size(self, face: int) -> np.ndarray:
        """Return lengths (2,) in metres of a face along u and v."""
        return self.size[_FACE_AXES[face // 2]]

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return faces (N,) and positions (N, 2) of points (N, 3) on the surface."""
        return _face_of(self._to_cube(points))

    def face_points(self, face: int, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points and outward unit normals (N, 3) in the map frame at the positions `uv` (N, 2) of a face."""
        cube = _on_face(face, uv)
        normal = np.zeros(3)
        normal[face // 2] = 1.0 if face % 2 else -1.0
        points = self.centre + (0.5 * self.size * cube) @ self.R_map_solid.T
        return points, np.broadcast_to(self.R_map_solid @ normal, points.shape)

    def _to_cube(self, points: np.ndarray) -> np.ndarray:
        scale = (2.0 / self.size).astype(points.dtype)
        return rotate(self.R_map_solid.T, points - self.centre.astype(points.dtype)) * scale


@dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere.

    Attributes:
        centre: (3,) metres, map frame.
        radius: metres.
    """

    centre: np.ndarray
    radius: float

    def intersect(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the smallest t > 0 (N,) where `origin + t * directions` (N, 3) meets the surface; inf if none."""
        start = (origin - self.centre).astype(directions.dtype)
        square = np.einsum("ij,ij->i", directions, directions)
        nearest = -(directions @ start) / square
        # From the point of the line nearest to the centre, not b^2 - 4ac, whose digits cancel for a far small sphere.
        offset = start + nearest[:, None] * directions
        reach_squared = (self.radius**2 - np.einsum("ij,ij->i", offset, offset)) / square
        reach = np.sqrt(np.maximum(reach_squared, 0))
        t = np.where(nearest - reach > 0, nearest - reach, nearest + reach)
        return np.where((reach_squared >= 0) & (t > 0), t, np.inf)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance (N,) of points (N, 3) from the surface, negative inside."""
        return np.linalg.norm(points - self.centre, axis=1) - self.radius

    def grown(self, margin: float) -> Sphere:
        """Return the sphere with its radius longer by `margin` metres."""
        return Sphere(self.centre, self.radius + margin)

    def face_size(self, face: int) -> np.ndarray:
        """Return lengths (2,) in metres of a face along u and v through its middle: quarters of great circles."""
        return np.full(2, 0.5 * np.pi * self.radius)

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return faces (N,) and positions (N, 2) of points (N, 3) on the surface."""
        faces, uv = _face_of(points - self.centre.astype(points.dtype))
        return faces, np.arctan(uv) * (4.0 / np.pi)

    def face_points(self, face: int, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points and outward unit normals (N, 3) in the map frame at the positions `uv` (N, 2) of a face."""
        cube = _on_face(face, np.tan(uv * (np.pi / 4.0)))
        normals = cube / np.linalg.norm(cube, axis=1, keepdims=True)
        return self.centre + self.radius * normals, normals


Solid = Box | Sphere


def rotate(rotation: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Turn vectors (N, 3) by a rotation (3, 3).

    In memory all x come first, then all y, then all z: numpy is several times as fast with that.
    """
    return (rotation.astype(vectors.dtype) @ vectors.T).T


def _face_of(cube: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return faces (N,) of the cube that the rays from its middle through `cube` (N, 3) meet, and where (N, 2)."""
    rows = np.arange(len(cube))
    axis = np.abs(cube).argmax(axis=1)
    along = cube[rows, axis]
    uv = cube[rows[:, None], _FACE_AXES[axis]] / np.abs(along)[:, None]
    return 2 * axis + (along > 0), uv


def _on_face(face: int, uv: np.ndarray) -> np.ndarray:
    """Return points (N, 3) of the cube [-1, 1]^3 at the positions `uv` (N, 2) of a face."""
    cube = np.empty((len(uv), 3))
    cube[:, face // 2] = 1.0 if face % 2 else -1.0
    cube[:, _FACE_AXES[face // 2]] = uv
    return cube
