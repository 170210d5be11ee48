"""Small pictures of a map from where its view index would look: what there is to see, and free space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.index.placement import cover, overlap, radius, random_poses, seen_cells, sees
from gsfeatloc_ros.render import Render, Renderer

# As the index looks small: width, height and focal length in pixels. Hardly anything may be nearer than this share of
# the map's radius.
LOOK = (80, 60, 72.0)
_NEAR = 0.02


@dataclass(frozen=True, eq=False)
class Look:
    """A picture from a pose (4, 4), T_map_camera, in free space; `cells` are what it shows (index/placement.py)."""

    pose: np.ndarray
    render: Render
    cells: set[int]


def pinhole(width: int, height: int, focal_length: float) -> Camera:
    """Return the camera of a picture without distortion."""
    K = np.array([[focal_length, 0, (width - 1) / 2], [0, focal_length, (height - 1) / 2], [0, 0, 1]])
    return Camera(width, height, K)


def look_around(
    renderer: Renderer, count: int, seed: int = 0, progress: Callable[[int, int], None] = lambda done, total: None
) -> list[Look]:
    """Look from `count` random poses; return the looks that are in free space and show surfaces.

    Raises:
        ValueError: nothing in the map is solid.
    """
    camera, points = pinhole(*LOOK), renderer.solid_points
    poses, distances = random_poses(points, count, np.random.default_rng(seed))
    near = _NEAR * radius(points)
    looks = []
    for number, (pose, distance) in enumerate(zip(poses, distances, strict=True)):
        progress(number, count)
        render = renderer.render(camera, pose).on_host()
        cells = seen_cells(render, camera, pose, near) if sees(render, distance) else set()
        if cells:
            looks.append(Look(pose, render, cells))
    progress(count, count)
    return looks


def choose(looks: Sequence[Look], count: int) -> list[Look]:
    """Return up to `count` looks that show most of what all of them show."""
    cells = [look.cells for look in looks]
    return [looks[number] for number in cover(overlap(cells, cells), count)]
