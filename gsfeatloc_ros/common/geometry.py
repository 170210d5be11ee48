"""Rigid-body geometry: SE(3), quaternions, perturbations and pose errors.

A pose ``T_a_b`` is a 4x4 float64 matrix that maps points of frame b into frame a. Quaternions are xyzw, as in ROS.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

# Below this angle (radians) the closed forms divide nearly 0 by nearly 0: use their series.
_SMALL_ANGLE = 1e-6


def make_pose(rotation: ArrayLike, translation: ArrayLike) -> np.ndarray:
    """Build a pose (4, 4) from a rotation matrix (3, 3) and a translation (3,)."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def invert(pose: np.ndarray) -> np.ndarray:
    """Invert a rigid pose (4, 4): ``invert(T_a_b)`` is ``T_b_a``."""
    rotation = pose[:3, :3].T
    return make_pose(rotation, -rotation @ pose[:3, 3])


def transform(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Map points (N, 3) of frame b into frame a by ``T_a_b`` (4, 4)."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def skew(vector: np.ndarray) -> np.ndarray:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3): ``skew(a) @ b == cross(a, b)``."""
    vector = np.asarray(vector, dtype=np.float64)
    matrices = np.zeros((*vector.shape, 3))
    for row, column, axis in ((2, 1, 0), (0, 2, 1), (1, 0, 2)):
        matrices[..., row, column] = vector[..., axis]
        matrices[..., column, row] = -vector[..., axis]
    return matrices


def so3_exp(rotation_vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a rotation vector (3,) in radians (Rodrigues' formula)."""
    angle = np.linalg.norm(rotation_vector)
    cross = skew(rotation_vector)
    if angle < _SMALL_ANGLE:
        return np.eye(3) + cross + 0.5 * cross @ cross
    return np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * cross @ cross


def so3_log(rotation: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,) in radians, of norm at most pi, of a rotation matrix (3, 3)."""
    x, y, z, w = quaternion_from_matrix(rotation)
    sine = np.sqrt(x * x + y * y + z * z)
    scale = 2.0 / w if sine < _SMALL_ANGLE else 2.0 * np.arctan2(sine, w) / sine
    return scale * np.array([x, y, z])


def matrix_from_quaternion(quaternion: ArrayLike) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a quaternion (4,) xyzw of any positive norm.

    Raises:
        ValueError: the quaternion is not finite or its norm is (nearly) zero.
    """
    quaternion = np.asarray(quaternion, dtype=np.float64)
    norm = np.linalg.norm(quaternion)
    if not np.isfinite(norm) or norm < 1e-9:
        raise ValueError(f"quaternion {quaternion.tolist()} has no direction: it must be finite and not zero")
    x, y, z, w = quaternion / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_matrix(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (4,) xyzw with w >= 0 of a rotation matrix (3, 3) (Shepperd's method, 1978)."""
    m = rotation
    # Four times the squared components; the largest is the safe one to divide by.
    squares = np.array(
        [
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
            1 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
    largest = int(np.argmax(squares))
    if largest == 0:
        q = np.array([squares[0], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]])
    elif largest == 1:
        q = np.array([m[0, 1] + m[1, 0], squares[1], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]])
    elif largest == 2:
        q = np.array([m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[2], m[1, 0] - m[0, 1]])
    else:
        q = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], squares[3]])
    q /= np.linalg.norm(q)
    return -q if q[3] < 0 else q


def pose_from_numbers(numbers: ArrayLike) -> np.ndarray:
    """Return the pose (4, 4) of seven numbers: x y z and a quaternion qx qy qz qw of any positive norm.

    Raises:
        ValueError: they are not seven finite numbers, or the quaternion is (nearly) zero.
    """
    values = np.asarray(numbers, dtype=np.float64)
    if values.shape != (7,) or not np.isfinite(values).all():
        raise ValueError(f"{values.tolist()} is no pose: seven finite numbers x y z qx qy qz qw")
    return make_pose(matrix_from_quaternion(values[3:]), values[:3])


def moved(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4) after a step (6,): moved by the first three, turned on the left by a rotation vector."""
    return make_pose(so3_exp(step[3:]) @ pose[:3, :3], pose[:3, 3] + step[:3])


def interpolate(pose_a: np.ndarray, pose_b: np.ndarray, fraction: float) -> np.ndarray:
    """Return the pose (4, 4) at a fraction of the way from one to another: straight, turning evenly about one axis."""
    turn = so3_log(pose_a[:3, :3].T @ pose_b[:3, :3])
    translation = (1 - fraction) * pose_a[:3, 3] + fraction * pose_b[:3, 3]
    return make_pose(pose_a[:3, :3] @ so3_exp(fraction * turn), translation)


def flattened(pose: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) on the plane z = 0 and upright that has the same x, y and yaw."""
    yaw = np.arctan2(pose[1, 0], pose[0, 0])
    return make_pose(so3_exp(np.array([0.0, 0.0, yaw])), [pose[0, 3], pose[1, 3], 0.0])


def isotropic_covariance(translation: float, rotation: float) -> np.ndarray:
    """Return the covariance (6, 6) of a pose of which all axes are known alike, by standard deviations (radians)."""
    return np.diag(np.square([translation] * 3 + [rotation] * 3))


def rotate_covariance(covariance: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Turn the covariance (6, 6) of a pose from the axes of frame b to those of frame a, by R_a_b (3, 3)."""
    both = np.kron(np.eye(2), rotation)
    return both @ covariance @ both.T


def shift_covariance(covariance: np.ndarray, lever: np.ndarray) -> np.ndarray:
    """Return the covariance (6, 6) of the pose of another point of the same body.

    To first order: a small rotation w moves the point at `lever` by w x lever.

    Args:
        covariance: (6, 6) in ROS order (x y z, rotation about x y z).
        lever: (3,) from the point that the covariance is of to the other, about the same axes.
    """
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -skew(lever)
    return jacobian @ covariance @ jacobian.T


def random_unit_vector(rng: np.random.Generator) -> np.ndarray:
    """Draw a direction (3,) uniform on the sphere."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def rotation_error_deg(pose_a: np.ndarray, pose_b: np.ndarray) -> float:
    """Return the angle in degrees between the rotations of two poses (4, 4)."""
    return float(np.degrees(np.linalg.norm(so3_log(pose_a[:3, :3].T @ pose_b[:3, :3]))))


def translation_error(pose_a: np.ndarray, pose_b: np.ndarray) -> float:
    """Return the distance between the origins of two poses (4, 4), in the units of their frame."""
    return float(np.linalg.norm(pose_a[:3, 3] - pose_b[:3, 3]))
