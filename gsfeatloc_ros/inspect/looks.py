"""Small pictures of a map from where its view index would look: what there is to see, and free space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.index import IndexOptions
from gsfeatloc_ros.index.placement import NEAR, SMALL_VIEW, cover, overlap, radius, random_poses, seen_cells, sees
from gsfeatloc_ros.render import Render, Renderer


@dataclass(frozen=True, eq=False)
class Look:
    """A picture by SMALL_VIEW from a pose (4, 4), T_map_camera, in free space, and the cells that it shows."""

    pose: np.ndarray
    render: Render
    cells: set[int]


def look_around(
    renderer: Renderer, count: int, seed: int = 0, progress: Callable[[int, int], None] = lambda done, total: None
) -> list[Look]:
    """Look from `count` random poses; return the looks that are in free space and show surfaces.

    Raises:
        ValueError: nothing in the map is solid.
    """
    points = renderer.solid_points
    poses, targets = random_poses(points, count, np.random.default_rng(seed), IndexOptions())
    near = NEAR * radius(points)
    looks = []
    for number, (pose, target) in enumerate(zip(poses, targets, strict=True)):
        progress(number, count)
        render = renderer.render(SMALL_VIEW, pose).on_host()
        cells = seen_cells(render, SMALL_VIEW, pose, near) if sees(render, SMALL_VIEW, pose, target) else set()
        if cells:
            looks.append(Look(pose, render, cells))
    progress(count, count)
    return looks


def choose(looks: Sequence[Look], count: int) -> list[Look]:
    """Return up to `count` looks that show most of what all of them show."""
    cells = [look.cells for look in looks]
    return [looks[number] for number in cover(overlap(cells, cells), count)]
