"""A camera in the form that the kernels take it, and what of a map it may see."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.kernels import njit
from gsfeatloc_ros.render.base import EPS2D, MIN_ALPHA, NEAR_PLANE

# Pixels by which the blur can widen a Gaussian.
_MAX_BLUR = np.sqrt(2 * np.log(1.0 / MIN_ALPHA) * EPS2D)


class CameraView(NamedTuple):
    """A camera at a pose in the splat frame.

    Attributes:
        rotation: (3, 3) float32, splat to camera.
        origin, forward: (3,) float64, the camera's centre and its optical axis: maps may lie far from their origin,
            where float32 would not be enough.
        fx, fy, cx, cy: float32 intrinsics, pixels.
        left, right, top, bottom: float32 slopes x/z and y/z beyond which a Gaussian is linearised as if it were there.
        width, height: pixels.
    """

    rotation: np.ndarray
    origin: np.ndarray
    forward: np.ndarray
    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    left: np.float32
    right: np.float32
    top: np.float32
    bottom: np.float32
    width: int
    height: int


def camera_view(camera: Camera, T_splat_camera: np.ndarray) -> CameraView:
    """Return the view of `camera` (its distortion ignored) from the pose `T_splat_camera` (4, 4)."""
    (fx, _, cx), (_, fy, cy) = camera.K[0], camera.K[1]
    # As in gsplat, 30 % outside the image; the image begins half a pixel before the centre of the first pixel.
    margin_x, margin_y = 0.3 * 0.5 * camera.width / fx, 0.3 * 0.5 * camera.height / fy
    return CameraView(
        rotation=np.ascontiguousarray(T_splat_camera[:3, :3].T, dtype=np.float32),
        origin=np.array(T_splat_camera[:3, 3], dtype=np.float64),
        forward=np.array(T_splat_camera[:3, 2], dtype=np.float64),
        fx=np.float32(fx),
        fy=np.float32(fy),
        cx=np.float32(cx),
        cy=np.float32(cy),
        left=np.float32(-(cx + 0.5) / fx - margin_x),
        right=np.float32((camera.width - cx - 0.5) / fx + margin_x),
        top=np.float32(-(cy + 0.5) / fy - margin_y),
        bottom=np.float32((camera.height - cy - 0.5) / fy + margin_y),
        width=camera.width,
        height=camera.height,
    )


def visible_chunks(view: CameraView, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the indices (n,) int64, ascending, of the chunks that `view` may see a part of.

    Their boxes are `low` to `high` (C, 3), splat frame.

    A Gaussian is drawn as wide as the linearised projection makes it, not as wide as it would be seen. One outside a
    side of the frustum is linearised at a slope up to a margin further out: it reaches further in than its box by at
    most that margin times its extent in depth.
    """
    return _chunks_inside(low, high, view.origin, *frustum(view))


def frustum(view: CameraView) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the sides that `is_outside` holds boxes against: four of the frustum, and the near plane.

    Returns:
        Normals (5, 3) that point inwards, splat frame; how much further in than its box a Gaussian may reach, as a
        share of the box's extent in depth (5,); the least distances along the normals (5,).
    """
    left, right = ((-_MAX_BLUR - view.cx) / view.fx, (view.width - 1 + _MAX_BLUR - view.cx) / view.fx)
    top, bottom = ((-_MAX_BLUR - view.cy) / view.fy, (view.height - 1 + _MAX_BLUR - view.cy) / view.fy)
    inward = np.array(
        [[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom], [0, 0, 1]], dtype=np.float64
    ) @ view.rotation.astype(np.float64)
    margins = np.abs([left - view.left, view.right - right, top - view.top, view.bottom - bottom, 0.0])
    limits = np.array([0.0, 0.0, 0.0, 0.0, NEAR_PLANE])
    return inward, margins, limits


@njit(nogil=True, cache=True)
def _chunks_inside(low, high, origin, inward, margins, limits):
    chunks = np.empty(len(low), dtype=np.int64)
    count = 0
    for chunk in range(len(low)):
        if not is_outside(low[chunk], high[chunk], origin, inward, margins, limits):
            chunks[count] = chunk
            count += 1
    return chunks[:count]


@njit
def is_outside(low, high, origin, inward, margins, limits):
    """Return whether nothing in a box, `low` to `high` (3,), is seen from `origin`; the rest is of `frustum`."""
    outside = False
    for side in range(len(inward)):
        furthest = rounding = 0.0
        for axis in range(3):
            center = 0.5 * (np.float64(low[axis]) + high[axis]) - origin[axis]
            half = 0.5 * (np.float64(high[axis]) - low[axis])
            normal, depth_axis = inward[side, axis], inward[-1, axis]
            furthest += normal * center + (abs(normal) + margins[side] * abs(depth_axis)) * half
            rounding += 1e-5 * abs(normal) * (abs(center) + half)
        # False for what is not finite: that is for the projection to judge.
        outside |= furthest + rounding < limits[side]
    return outside
