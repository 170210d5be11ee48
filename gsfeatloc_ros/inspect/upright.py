"""Where up is in a map, and its floor: rooms and what stands in them are made of level and upright surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.inspect.floor import find_floor
from gsfeatloc_ros.inspect.surfaces import Surfaces

# Surfaces this close to level, or upright, count as that.
_TOLERANCE = np.radians(12.0)
_REFINED = np.radians(6.0)
# Directions that are tried: one every six degrees. Enough normals to tell them apart.
_DIRECTIONS = 1500
_MAX_NORMALS = 10_000
# The axis is sure where so large a share of all surfaces is level. In maps of rooms and tables it was 0.15 to 0.6, of
# single plants and toys 0.04 to 0.08.
_MIN_LEVEL = 0.12
# Which way is up is told by the level surfaces between the lowest and the highest tenth: tops are seen, undersides are
# not. It is sure where the tops are so much more: (tops - undersides) / (tops + undersides).
_MIDDLE = (0.1, 0.9)
_MIN_EXCESS = 0.35
# A floor holds this share of what faces up.
_MIN_FLOOR_SHARE = 0.1
# It is looked for from so much above what faces up, as a share of the height of all.
_ABOVE = 0.01
# A ceiling is higher above the floor than this share of the height, and holds this share of what the floor does.
_MIN_CEILING = 0.4
_MIN_CEILING_SHARE = 0.3


@dataclass(frozen=True)
class Upright:
    """Where up is, in the map frame.

    Attributes:
        up: unit vector.
        level: share of the surfaces that are level then.
        excess: how much more tops than undersides there are, -1 to 1.
        sure: whether `level` and `excess` suffice; otherwise `up` is a guess.
        floor: height of the floor along `up`, in map units; None where there is none.
        ceiling: height of the ceiling; None where there is none.
    """

    up: list[float]
    level: float
    excess: float
    sure: bool
    floor: float | None
    ceiling: float | None

    @property
    def tilt_deg(self) -> float:
        """Angle between up and the map frame's z, in degrees."""
        return float(np.degrees(np.arccos(np.clip(self.up[2], -1.0, 1.0))))


def find_upright(surfaces: Surfaces) -> Upright | None:
    """Return where up is likely to be; None where there are no surfaces."""
    if len(surfaces.points) == 0:
        return None
    normals = surfaces.normals[:: -(-len(surfaces.normals) // _MAX_NORMALS)]
    axis = _axis(normals)
    heights, cosines = surfaces.points @ axis, surfaces.normals @ axis
    low, high = np.percentile(heights, [2, 98])
    place = (heights - low) / max(high - low, 1e-12)
    middle = (place > _MIDDLE[0]) & (place < _MIDDLE[1])
    tops, undersides = (int(np.sum(middle & (sign * cosines > np.cos(_TOLERANCE)))) for sign in (1, -1))
    excess = (tops - undersides) / max(tops + undersides, 1)
    sign = 1.0 if excess >= 0 else -1.0
    level = float(np.mean(np.abs(cosines) > np.cos(_TOLERANCE)))
    up = sign * axis
    floor, ceiling = _floor_and_ceiling(surfaces, up, float(high - low))
    return Upright(
        up=up.tolist(),
        level=level,
        excess=abs(excess),
        sure=level >= _MIN_LEVEL and abs(excess) >= _MIN_EXCESS,
        floor=floor,
        ceiling=ceiling,
    )


def _floor_and_ceiling(surfaces: Surfaces, up: np.ndarray, height: float) -> tuple[float | None, float | None]:
    """Return the heights of floor and ceiling along up (3,), None for what is not there; `height` is of all of them."""
    cosines = surfaces.normals @ up
    faces_up, faces_down = (surfaces.points[sign * cosines > np.cos(_TOLERANCE)] for sign in (1, -1))
    floor = _lowest(faces_up, up, height, _MIN_FLOOR_SHARE * len(faces_up))
    if floor is None:
        return None, None
    above = faces_down[faces_down @ up > floor[0] + _MIN_CEILING * height]
    ceiling = _lowest(above, -up, height, _MIN_CEILING_SHARE * floor[1])
    return floor[0], None if ceiling is None else -ceiling[0]


def _lowest(points: np.ndarray, up: np.ndarray, height: float, count: float) -> tuple[float, float] | None:
    """Return the height of the lowest large plane of points (n, 3), and how many are on it; None for less than `count`.

    It is seen from above all of them, and from at least `height` above the lowest: planes are as thick everywhere.
    """
    if len(points) == 0:
        return None
    centre = points.mean(axis=0)
    heights = points @ up
    eye = max(heights.max() + _ABOVE * height, heights.min() + height)
    above = centre + (eye - centre @ up) * up
    floor = find_floor(points, np.ones(len(points)), above[None], up)
    if floor is None or floor.share * len(points) < max(count, 3):
        return None
    return float(floor.point @ up), floor.share * len(points)


def _axis(normals: np.ndarray) -> np.ndarray:
    """Return the axis (3,), up or down, of which most surfaces are level and upright."""
    candidates = _half_sphere(_DIRECTIONS)
    cosines = np.abs(normals.astype(np.float32) @ candidates.T.astype(np.float32))
    level = (cosines > np.cos(_TOLERANCE)).mean(axis=0)
    upright = (cosines < np.sin(_TOLERANCE)).mean(axis=0)
    # Of one plane alone, all axes in it would have everything upright; of a ball no axis has much of both.
    axis = candidates[int((level * (upright + 0.01)).argmax())]
    for tolerance in (_TOLERANCE, _TOLERANCE, _REFINED, _REFINED, _REFINED):
        along = normals @ axis
        close = normals[np.abs(along) > np.cos(tolerance)]
        if len(close) == 0:
            break
        # The direction of which the squared sines of the normals are least in sum.
        found = np.linalg.eigh(close.T @ close)[1][:, -1]
        axis = found * np.sign(found @ axis)
    return axis


def _half_sphere(count: int) -> np.ndarray:
    """Return `count` directions (count, 3) spread over the half of the sphere above z = 0 (a Fibonacci lattice)."""
    z = 1 - (np.arange(count) + 0.5) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.column_stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])
