"""Poses and covariances as shapes that can be drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsfeatloc_ros.common.geometry import transform

# A camera's corners, left to right and top to bottom, and a mark above its image, one unit ahead (x right, y down).
_CORNERS = np.array([[-0.6, -0.45, 1.0], [0.6, -0.45, 1.0], [0.6, 0.45, 1.0], [-0.6, 0.45, 1.0]])
_TOP = np.array([[-0.3, -0.5, 1.0], [0.0, -0.75, 1.0], [0.3, -0.5, 1.0]])
_EDGES = np.array(
    [
        *[(np.zeros(3), corner) for corner in _CORNERS],
        *zip(_CORNERS, np.roll(_CORNERS, -1, axis=0), strict=True),
        *zip(_TOP, np.roll(_TOP, -1, axis=0), strict=True),
    ]
)
# Lines of a camera.
EDGES = len(_EDGES)

# A base: a box, half a unit to each side of where it stands and as high, and on top of it an arrow to one unit ahead
# (x ahead, y left, z up).
_GROUND = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
_ROOF = _GROUND + np.array([0.0, 0.0, 0.5])
_TIP = np.array([1.0, 0.0, 0.5])
_ARROW = np.array([[0.0, 0.0, 0.5], [0.7, 0.2, 0.5], [0.7, -0.2, 0.5]])
_BASE = np.array(
    [
        *zip(_GROUND, np.roll(_GROUND, -1, axis=0), strict=True),
        *zip(_ROOF, np.roll(_ROOF, -1, axis=0), strict=True),
        *zip(_GROUND, _ROOF, strict=True),
        *[(_TIP, end) for end in _ARROW],
    ]
)


def frustums(poses: Sequence[np.ndarray], size: float) -> np.ndarray:
    """Return cameras at poses (4, 4), T_map_camera, as lines (N * EDGES, 2, 3), `size` from the centre to the image."""
    ends = size * _EDGES.reshape(-1, 3)
    return np.array([transform(pose, ends) for pose in poses]).reshape(-1, 2, 3)


def base_box(pose: np.ndarray, size: float) -> np.ndarray:
    """Return a base at a pose (4, 4), T_map_base, as lines (L, 2, 3): a box `size` wide with an arrow ahead."""
    return transform(pose, size * _BASE.reshape(-1, 3)).reshape(-1, 2, 3)


def ellipsoids(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ellipsoids of one standard deviation of positions.

    Args:
        covariances: (N, 3, 3), symmetric; what rounding makes negative counts as 0.

    Returns:
        Rotation matrices (N, 3, 3), whose columns are the axes, and half their lengths (N, 3).
    """
    squares, axes = np.linalg.eigh(covariances.reshape(-1, 3, 3))
    # Axes of a right hand.
    axes[..., 0] *= np.sign(np.linalg.det(axes))[:, None]
    return axes, np.sqrt(np.maximum(squares, 0.0))


def looking_along(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a camera at a point (3,) that looks along a direction (3,) of any length."""
    ahead = direction / np.linalg.norm(direction)
    # Any axis that is not along it.
    right = np.cross(np.eye(3)[np.argmin(np.abs(ahead))], ahead)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = origin
    return pose
