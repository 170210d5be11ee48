"""Where a map's own frame lies in the robot's map frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsfeatloc_ros.common.geometry import make_pose

# How far the rows of a rotation matrix may be from orthonormal: nerfstudio writes float32.
_ORTHONORMAL_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Similarity:
    """A change of frame and of unit: ``S_a_b`` maps a point of frame b to ``scale * rotation @ point + translation``.

    Attributes:
        scale: units of frame a in one unit of frame b, > 0.
        rotation: (3, 3) float64 rotation matrix.
        translation: (3,) float64, units of frame a.

    Raises:
        ValueError: the scale is not a positive number, the rotation is none, or a value is not finite.
    """

    scale: float = 1.0
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    translation: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        rotation, translation = np.array(self.rotation, np.float64), np.array(self.translation, np.float64)
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"scale {self.scale} is not a positive number")
        if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=_ORTHONORMAL_TOLERANCE):
            raise ValueError(f"{rotation.tolist()} is not a rotation matrix")
        if np.linalg.det(rotation) < 0:
            raise ValueError(f"{rotation.tolist()} mirrors: it is not a rotation matrix")
        if translation.shape != (3,) or not np.isfinite(translation).all():
            raise ValueError(f"translation {translation.tolist()} is not three finite numbers")
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    def __matmul__(self, other: Similarity) -> Similarity:
        """Chain changes of frame: ``S_a_b @ S_b_c`` is ``S_a_c``."""
        return Similarity(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            self.scale * self.rotation @ other.translation + self.translation,
        )

    def inverse(self) -> Similarity:
        """Invert the change of frame: ``S_a_b.inverse()`` is ``S_b_a``."""
        return Similarity(1.0 / self.scale, self.rotation.T, -self.rotation.T @ self.translation / self.scale)

    def transform(self, points: np.ndarray) -> np.ndarray:
        """Map points (N, 3) of frame b into frame a."""
        return self.scale * points @ self.rotation.T + self.translation

    def transform_pose(self, T_b_camera: np.ndarray) -> np.ndarray:
        """Return the pose (4, 4) in frame a of a camera in frame b; its own axes take on the unit of frame a."""
        return make_pose(self.rotation @ T_b_camera[:3, :3], self.transform(T_b_camera[None, :3, 3])[0])
