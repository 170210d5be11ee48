"""Boxes covered with Gaussians that are like trained ones in what decides how long a frame takes."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.geometry import make_pose
from gsfeatloc_ros.maps.assemble import SH_C0
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap

# Of trained maps: the standard deviation along a surface over the distance to the neighbours, and the spread of its
# logarithm; that across the surface over that along it; how far Gaussians lie off the surface, in metres; the beta
# distribution of opacities, of which most are faint; the harmonics' standard deviations by degree.
_SIZE, _SIZE_SPREAD = 0.75, 0.5
_FLATNESS = 0.15
_ROUGHNESS = 0.01
_OPACITIES = (0.9, 0.8)
_HARMONICS = (0.1, 0.05, 0.03)


def looking_at(position: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """Return the pose T_map_camera (4, 4) of an upright camera."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return make_pose(np.column_stack([right, np.cross(forward, right), forward]), np.array(position))


def cover_boxes(
    boxes: np.ndarray, doors: np.ndarray, count: int, rng: np.random.Generator, sh_degree: int = 3
) -> GaussianMap:
    """Cover the faces of boxes with `count` Gaussians, the smaller the more there are.

    Args:
        boxes: (B, 2, 3) lowest and highest corners, metres, z up.
        doors: (D, 2, 3) of boxes in which there is nothing.
        count: how many.
        rng: by which they are strewn.
        sh_degree: of the spherical harmonics.
    """
    means, normals, spacing = _scatter(boxes, doors, count, rng)
    each = np.arange(count)
    scales = _SIZE * spacing * np.exp(_SIZE_SPREAD * rng.standard_normal((count, 3), dtype=np.float32))
    scales[each, normals] *= _FLATNESS
    # Turned about the normal, which is one of the axes.
    half_angles = rng.uniform(0, np.pi, count)
    rotations = np.zeros((count, 4), np.float32)
    rotations[:, 0] = np.cos(half_angles)
    rotations[each, 1 + normals] = np.sin(half_angles)
    return GaussianMap(
        means=means,
        scales=scales.astype(np.float32),
        rotations=rotations,
        opacities=rng.beta(*_OPACITIES, count).astype(np.float32),
        sh=_colours(means, rng, sh_degree),
    )


def _scatter(
    boxes: np.ndarray, doors: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return points (N, 3) float32 on the boxes, the axes (N,) along their normals, and the distance of neighbours."""
    sizes = boxes[:, 1] - boxes[:, 0]
    # Of the two faces across each axis.
    areas = np.column_stack([sizes[:, [1, 2]].prod(1), sizes[:, [2, 0]].prod(1), sizes[:, [0, 1]].prod(1)])
    box, axis = np.divmod(rng.choice(areas.size, 2 * count, p=areas.ravel() / areas.sum()), 3)
    place = rng.random((2 * count, 3), dtype=np.float32)
    each = np.arange(2 * count)
    place[each, axis] = np.rint(place[each, axis])
    points = boxes[box, 0] + place * sizes[box]
    points[each, axis] += rng.normal(0, _ROUGHNESS, 2 * count)
    in_door = np.any([((points > low) & (points < high)).all(axis=1) for low, high in doors], axis=0)
    kept = np.flatnonzero(~in_door)[:count]
    return points[kept].astype(np.float32), axis[kept], float(np.sqrt(2 * areas.sum() / count))


def _colours(means: np.ndarray, rng: np.random.Generator, sh_degree: int) -> np.ndarray:
    """Return harmonics (N, C, 3) float32 of waves of colour, as coarse as tiles and as fine as text."""
    sh = np.zeros((len(means), SH_COEFFICIENTS[sh_degree], 3), np.float32)
    for wavelength in (1.0, 0.3, 0.08):
        for channel in range(3):
            waves = rng.normal(0, 2 * np.pi / wavelength, 3).astype(np.float32)
            sh[:, 0, channel] += 0.12 / SH_C0 * np.sin(means @ waves)
    for degree, deviation in enumerate(_HARMONICS[:sh_degree], start=1):
        coefficients = slice(SH_COEFFICIENTS[degree - 1], SH_COEFFICIENTS[degree])
        shape = sh[:, coefficients].shape
        sh[:, coefficients] = deviation * rng.standard_normal(shape, dtype=np.float32)
    return sh
