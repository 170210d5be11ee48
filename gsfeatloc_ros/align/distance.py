"""The scale by one distance that is known, between two points of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.align.alignment import Alignment
from gsfeatloc_ros.align.pairs import Answer
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.pose.lift import LiftOptions, lift
from gsfeatloc_ros.render.base import Renderer

# Nanoseconds. Stamps that people copy are cut to milliseconds.
_SAME_STAMP = 1_000_000


@dataclass(frozen=True, eq=False)
class MapPoint:
    """A point of the map.

    Attributes:
        position: (3,) frame in which the map lies.
        sigma: (3,) one standard deviation, along the ray that it was seen by; zeros where it is not known.
    """

    position: np.ndarray
    sigma: np.ndarray


def scale_by_distance(points: tuple[MapPoint, MapPoint], metres: float) -> Alignment:
    """Return the scale that puts two points a distance apart.

    Raises:
        ValueError: the points are the same.
    """
    between = points[1].position - points[0].position
    length = float(np.linalg.norm(between))
    if not length > 0:
        raise ValueError("the two points are the same: name two that are far apart")
    sigma = float(np.hypot(*(point.sigma @ between / length for point in points))) / length
    report = [
        f"{length:.6g} units are {metres:g} m: scale {metres / length:.6g}",
        "the scale is as exact as the distance and the two points; rotation and translation are only scaled",
    ]
    if sigma:
        report.insert(1, f"standard deviation by the map's depth: {100 * sigma:.2f} %")
    return Alignment(Similarity(metres / length), complete=False, report=report)


def point_at(renderer: Renderer, camera: Camera, answers: Sequence[Answer], stamp: int, pixel: np.ndarray) -> MapPoint:
    """Return the point of the map at a pixel (2,) of a photo, as observed.

    Raises:
        ValueError: no answer has this stamp (nanoseconds), or the map has no sure depth there.
    """
    nearest = min(answers, key=lambda answer: abs(answer.stamp - stamp))
    if abs(nearest.stamp - stamp) > _SAME_STAMP:
        raise ValueError(f"no photo of {stamp / 1e9:.3f} was localized; the nearest is of {nearest.stamp / 1e9:.3f}")
    pinhole = camera.pinhole()
    render = renderer.render(pinhole, nearest.T_map_camera).on_host()
    lifted = lift(render, pinhole, nearest.T_map_camera, camera.undistort(pixel[None]), LiftOptions())
    if not lifted.valid[0]:
        raise ValueError(
            f"the map has no sure depth at pixel {pixel[0]:g} {pixel[1]:g} of {stamp / 1e9:.3f}: take one on a "
            "surface, not on an edge"
        )
    return MapPoint(lifted.points[0], lifted.sigmas[0])
