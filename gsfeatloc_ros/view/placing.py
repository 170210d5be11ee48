"""Where the map lies, as it is set step by step by what was clicked: the steps are those of gsfeatloc align."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsfeatloc_ros.align.alignment import Alignment, write_parameters
from gsfeatloc_ros.align.distance import MapPoint, scale_by_distance
from gsfeatloc_ros.align.fit import UndeterminedError
from gsfeatloc_ros.align.gravity import Up
from gsfeatloc_ros.align.level import level, level_by_points
from gsfeatloc_ros.align.pairs import Answer
from gsfeatloc_ros.index.placement import radius
from gsfeatloc_ros.inspect.looks import Look, look_around
from gsfeatloc_ros.inspect.surfaces import find_surfaces
from gsfeatloc_ros.inspect.upright import find_upright
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.maps import GaussianMap
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.render import Renderer, create_renderer

# Poses that are looked from to tell what is up, as inspect does.
_LOOKS = 400


class Placing:
    """From the frame in which the map is shown to the robot's.

    Points and poses are given in the frame in which the map is shown, which stays.

    Args:
        map_: where the map is shown.
    """

    def __init__(self, map_: MapSettings) -> None:
        self._map = map_
        self.reset()

    def reset(self) -> None:
        """Begin anew, where the map is shown."""
        self.S_robot_shown = Similarity()
        self.report: list[str] = []
        self._complete = self._map.aligned

    def set_floor(self, points: np.ndarray, above: np.ndarray, metres: bool) -> None:
        """Put the floor through points (N, 3), below another (3,), to z = 0; raise ValueError as level_by_points."""
        self._take(level_by_points(self._now(points), self._now(above[None])[0], metres))

    def set_scale(self, first: np.ndarray, second: np.ndarray, metres: float) -> None:
        """Put two points (3,) a distance apart; raise ValueError where they are the same."""
        now = self._now(np.array([first, second]))
        step = scale_by_distance((MapPoint(now[0], np.zeros(3)), MapPoint(now[1], np.zeros(3))), metres)
        self._take(Alignment(step.S_robot_map, self._complete, step.report))

    def find_floor(self, gaussian_map: GaussianMap, metres: bool) -> None:
        """Find up as inspect does, and the floor as align does; raise ValueError where the map does not tell."""
        placed = gaussian_map.placed(self.S_robot_shown)
        renderer = create_renderer(placed, "cpu")
        looks = look_around(renderer, _LOOKS)
        up = _up(renderer, looks)
        heights = np.array([look.pose[:3, 3] @ up for look in looks])
        # Some looks are from below the floor, where nobody stood.
        upper = [look for look, height in zip(looks, heights, strict=True) if height >= np.median(heights)]
        answers = [Answer(0, look.pose, np.zeros(2)) for look in upper]
        self._take(level(Up(up, 0.0, len(looks)), placed, answers, by_floor=True, metres=metres))

    def settings(self) -> MapSettings:
        """Return the map's parameters; raise ValueError where they are out of their range."""
        return Alignment(self.S_robot_shown, self._complete, self.report).applied_to(self._map)

    def write(self, path: Path) -> None:
        """Write the parameters for the node; raise ValueError or OSError where that cannot be done."""
        about = "where the map lies in the robot's frame, as set in gsfeatloc view"
        write_parameters(path, self.settings(), [about, *self.report])

    def _now(self, points: np.ndarray) -> np.ndarray:
        return self.S_robot_shown.transform(points)

    def _take(self, step: Alignment) -> None:
        self.S_robot_shown = step.S_robot_map @ self.S_robot_shown
        self.report += step.report
        self._complete = step.complete


def _up(renderer: Renderer, looks: list[Look]) -> np.ndarray:
    """Return what is up (3,), a unit vector."""
    upright = find_upright(find_surfaces(looks, radius(renderer.solid_points)))
    if upright is None or not upright.sure:
        raise UndeterminedError("which way is up cannot be told from the map: click three points on the floor")
    return np.array(upright.up)
