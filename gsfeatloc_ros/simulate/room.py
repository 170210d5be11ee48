"""A room of textured solids and its ray tracer: the truth of the tests and of the demo.

Nothing here is shared with the Gaussian renderers.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.simulate.solids import Box, Solid, Sphere, rotate
from gsfeatloc_ros.simulate.texture import paint

# Width of a texel in metres: at most a pixel of the photos, wherever a camera stands.
TEXEL = 0.005
# Direction to the lamp that shades the solids, from the map frame.
_LIGHT = np.array([0.4, -0.5, 0.77])


def _xyz(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z])


_SHELL = Box(_xyz(0.0, 0.0, 1.5), _xyz(6.0, 5.0, 3.0))
_FURNITURE = (
    Box(_xyz(0.1, 0.05, 0.4), _xyz(1.2, 0.7, 0.8), yaw=0.35),  # a table, and a crate and a ball on it
    Box(_xyz(0.4, 0.15, 0.95), _xyz(0.35, 0.3, 0.3), yaw=0.9),
    Sphere(_xyz(-0.25, 0.0, 1.03), 0.23),
    Box(_xyz(-2.7, 0.9, 1.0), _xyz(0.5, 1.6, 2.0)),  # a shelf
    Box(_xyz(2.45, -1.6, 0.5), _xyz(0.8, 1.2, 1.0), yaw=-0.2),  # a cabinet and a ball on it
    Sphere(_xyz(2.45, -1.5, 1.3), 0.3),
    Box(_xyz(2.4, 1.9, 0.9), _xyz(0.6, 0.6, 1.8), yaw=0.5),  # a pillar
    Box(_xyz(-2.0, -1.9, 0.3), _xyz(0.7, 0.6, 0.6), yaw=0.6),  # two crates
    Box(_xyz(-2.0, -1.9, 0.8), _xyz(0.4, 0.45, 0.4), yaw=0.2),
    Sphere(_xyz(0.6, 2.0, 0.4), 0.4),
    Sphere(_xyz(-1.0, -2.1, 0.3), 0.3),
    Sphere(_xyz(0.3, -0.5, 2.55), 0.2),  # a lamp
    Box(_xyz(0.9, -2.43, 1.7), _xyz(1.4, 0.14, 0.9)),  # a picture
)


@dataclass(frozen=True, eq=False)
class RayTrace:
    """What a camera sees of the room.

    Attributes:
        rgb: (H, W, 3) float32 in [0, 1].
        depth: (H, W) float32 z-depth in metres of what the middle of each pixel sees.
    """

    rgb: np.ndarray
    depth: np.ndarray


class Room:
    """A furnished room of 6 x 5 x 3 metres, z up, the floor at z = 0. Its textures depend on the seed.

    Attributes:
        solids: the walls, seen from inside, and then the furniture.
        pictures: those (rows, cols, 3) uint8 RGB on the six faces of each solid; rows run along v, columns along u.
            What is painted on them is seen.
    """

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.solids: tuple[Solid, ...] = (_SHELL, *_FURNITURE)
        painted = [[_paint_face(rng, solid, face) for face in range(6)] for solid in self.solids]
        # All pictures under one another, so that one look-up serves all rays whatever they hit.
        shapes = np.array([[picture.shape[:2] for picture in faces] for faces in painted])
        rows = shapes[:, :, 0].ravel()
        tops = np.cumsum(rows) - rows
        self._atlas = np.zeros((rows.sum(), shapes[:, :, 1].max(), 3), np.uint8)
        self._places = [
            [np.s_[top : top + rows, :cols] for top, (rows, cols) in zip(*faces, strict=True)]
            for faces in zip(tops.reshape(shapes.shape[:2]), shapes, strict=True)
        ]
        self.pictures = self._pictures()
        for faces, there in zip(painted, self.pictures, strict=True):
            for picture, place in zip(faces, there, strict=True):
                place[:] = picture
        self._tops = tops.reshape(shapes.shape[:2]).astype(np.float32)
        self._extents = shapes[:, :, ::-1].astype(np.float32)

    def copy(self) -> Room:
        """Return a room that looks the same, whose pictures are its own to paint on."""
        other = copy(self)
        other._atlas = self._atlas.copy()
        other.pictures = other._pictures()
        return other

    def is_free(self, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Return whether points (N, 3) are inside the walls and outside all solids by `margin` metres: (N,) bool."""
        shell, *furniture = self.solids
        free = shell.distance(points) < -margin
        for solid in furniture:
            free &= solid.distance(points) > margin
        return free

    def ray_trace(self, camera: Camera, T_map_camera: np.ndarray, samples: int = 2) -> RayTrace:
        """Return what is seen through the lens of `camera`, its distortion included, from a pose (4, 4) in the room.

        The colour of a pixel is the mean of `samples` x `samples` rays through it.
        """
        offsets = (np.arange(samples) + 0.5) / samples - 0.5
        total = np.zeros((camera.height, camera.width, 3), np.float32)
        for x in offsets:
            for y in offsets:
                total += self.cast(pixel_rays(camera, (x, y)), T_map_camera)[0]
        return RayTrace(total / samples**2, self.cast(pixel_rays(camera), T_map_camera)[1])

    def cast(self, rays: np.ndarray, T_map_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return colours (H, W, 3) float32 in [0, 1] and z-depths (H, W) in metres at the ends of `rays` (H, W, 3).

        The rays are directions in the camera frame with z = 1; the camera is inside the room.
        """
        height, width = rays.shape[:2]
        origin = T_map_camera[:3, 3]
        directions = rotate(T_map_camera[:3, :3], rays.reshape(-1, 3))
        near = _may_meet(self.solids[1:], origin, directions)
        depth = self.solids[0].intersect(origin, directions)
        hit = np.zeros(len(depth), np.intp)
        for index, solid in enumerate(self.solids[1:], start=1):
            candidates = np.flatnonzero(near[index - 1])
            t = solid.intersect(origin, directions[candidates])
            closer = t < depth[candidates]
            depth[candidates[closer]], hit[candidates[closer]] = t[closer], index
        points = origin.astype(np.float32) + depth[:, None] * directions
        texels = self._texels(points, hit).reshape(height, width, 2)
        colours = cv2.remap(self._atlas, texels, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        return colours.astype(np.float32) / 255, depth.reshape(height, width)

    def _pictures(self) -> list[list[np.ndarray]]:
        """Return the pictures of the faces as they are in the atlas."""
        return [[self._atlas[place] for place in faces] for faces in self._places]

    def _texels(self, points: np.ndarray, hit: np.ndarray) -> np.ndarray:
        """Return where in the atlas (N, 2) the surface points (N, 3) of the solids `hit` (N,) are."""
        texels = np.empty((len(points), 2), np.float32)
        for index, solid in enumerate(self.solids):
            rows = np.flatnonzero(hit == index)
            faces, uv = solid.locate(points[rows])
            extents = self._extents[index, faces]
            # Clipped to the face, so that interpolation does not mix in the picture of another.
            texels[rows] = np.clip((uv + 1) / 2 * extents - 0.5, 0, extents - 1)
            texels[rows, 1] += self._tops[index, faces]
        return texels


def pixel_rays(camera: Camera, offset: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Return directions (H, W, 3) float32 in the camera frame, z = 1, of the pixels' centres moved by `offset`."""
    columns, rows = np.meshgrid(np.arange(camera.width) + offset[0], np.arange(camera.height) + offset[1])
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    return camera.rays(camera.undistort(pixels)).reshape(camera.height, camera.width, 3).astype(np.float32)


def _may_meet(solids: Sequence[Solid], origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return whether rays (N, 3) meet the spheres that hold the S solids: (S, N) bool."""
    towards = np.array([solid.centre - origin for solid in solids])
    distances = np.linalg.norm(towards, axis=1, keepdims=True)
    radii = np.array([[solid.radius] for solid in solids])
    # The cosine of half the angle at which the sphere is seen, a little less for rounding; -1 from inside it.
    cosines = np.where(distances > radii, 0.999 * np.sqrt(np.maximum(1 - (radii / distances) ** 2, 0)), -1.0)
    lengths = np.sqrt(np.einsum("ij,ij->i", directions, directions))
    return (towards / distances).astype(np.float32) @ directions.T >= cosines.astype(np.float32) * lengths


def _paint_face(rng: np.random.Generator, solid: Solid, face: int) -> np.ndarray:
    """Paint the picture of a face: rows run along v, columns along u."""
    cols, rows = np.maximum(np.rint(solid.face_size(face) / TEXEL), 1).astype(int)
    picture = paint(rng, rows, cols, TEXEL)
    # A flat face is of one shade.
    grid = (1, 1) if isinstance(solid, Box) else (rows, cols)
    _, normals = solid.face_points(face, grid_uv(*grid))
    shade = 0.8 + 0.2 * (normals @ _LIGHT)
    return (picture * shade.reshape(*grid, 1)).astype(np.uint8)


def grid_uv(rows: int, cols: int) -> np.ndarray:
    """Return positions (rows * cols, 2) on a face of the middles of the cells of a grid, row by row."""
    u, v = np.meshgrid((np.arange(cols) + 0.5) / cols * 2 - 1, (np.arange(rows) + 0.5) / rows * 2 - 1)
    return np.column_stack([u.ravel(), v.ravel()])
