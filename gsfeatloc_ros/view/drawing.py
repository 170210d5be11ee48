"""What is drawn in the page's scene, by groups that can be hidden."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import trimesh
from viser import ViserServer

from gsfeatloc_ros.common.geometry import quaternion_from_matrix
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.view.attempts import Attempt, Prior
from gsfeatloc_ros.view.shapes import EDGES, base_box, ellipsoids, frustums
from gsfeatloc_ros.view.splats import Splats

# RGB by how an attempt ended; others are grey.
COLOURS = {
    "localized": (30, 150, 70),
    "rejected": (235, 120, 20),
    "failed": (215, 40, 40),
    "ambiguous": (150, 60, 190),
    "unconfirmed": (40, 110, 220),
}
GREY = (120, 120, 120)
_PRIOR, _CHOSEN, _INDEX, _MARK = (250, 200, 20), (0, 190, 230), (110, 130, 170), (240, 30, 140)
_SEARCHED = (200, 120, 60)
# Of a camera, as a share of the map's radius; of views of the map less: there are many.
_CAMERA, _VIEW, _BASE, _AXES, _MARK_SIZE = 0.04, 0.015, 0.08, 0.08, 0.006
# Ellipsoids of this share of the radius can be seen.
_VISIBLE = 0.02
# Cells of the floor over the map, about, and the most.
_CELLS, _MAX_CELLS = 8, 200
_BALL = trimesh.creation.icosphere(subdivisions=2)


def linear(colours: np.ndarray) -> np.ndarray:
    """Return sRGB colours (..., 3) uint8 as linear light, which viser takes the colours of lines and meshes for."""
    return np.rint(255 * (colours / 255.0) ** 2.2).astype(np.uint8)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion (4,) wxyz, as viser has it, of a rotation matrix (3, 3)."""
    return np.roll(quaternion_from_matrix(rotation), 1)


class Drawing:
    """Draws in the scene of a server; what is drawn again takes the place of what was.

    Args:
        server: whose scene it is.
        radius: of the map, map units.
    """

    def __init__(self, server: ViserServer, radius: float) -> None:
        self._scene, self._radius = server.scene, radius
        self._drawn: dict[str, Any] = {}
        self._hidden: set[str] = set()

    def show(self, group: str, visible: bool) -> None:
        """Show or hide what is drawn in a group: now, and what is drawn there later."""
        (self._hidden.discard if visible else self._hidden.add)(group)
        for name, node in self._drawn.items():
            if name.split("/")[1] == group:
                node.visible = visible

    def map(self, splats: Splats) -> None:
        """Draw the map."""
        self._put(
            "/map",
            self._scene.add_gaussian_splats,
            centers=splats.centres,
            covariances=splats.covariances,
            rgbs=splats.colours,
            opacities=splats.opacities,
            scale=splats.unit,
            position=splats.origin,
        )

    def frame(self, S_shown_robot: Similarity) -> float:
        """Draw axes and floor of a frame that lies in the one in which the map is shown; return the floor's cell.

        Args:
            S_shown_robot: where it lies.

        Returns:
            Length of a cell, units of that frame.
        """
        scale = S_shown_robot.scale
        place = {"wxyz": quaternion(S_shown_robot.rotation), "position": S_shown_robot.translation}
        axes = _AXES * self._radius
        frame = self._scene.add_frame
        self._put("/axes", frame, **place, axes_length=axes, axes_radius=axes / 25, origin_radius=axes / 12)
        cell = round_down(2 * self._radius / scale / _CELLS)
        width = 2 * cell * min(np.ceil(self._radius / scale / cell) + 2, _MAX_CELLS / 2)
        self._put(
            "/floor",
            self._scene.add_grid,
            **place,
            width=width * scale,
            height=width * scale,
            cell_size=cell * scale,
            section_size=10 * cell * scale,
            cell_color=(150, 150, 150),
            section_color=(90, 90, 90),
            shadow_opacity=0.0,
        )
        self._scene.set_up_direction(S_shown_robot.rotation[:, 2])
        return cell

    def attempts(self, attempts: Sequence[Attempt], deviations: float) -> None:
        """Draw the answers, their ellipsoids of so many standard deviations, and what is ambiguous."""
        answers = [attempt for attempt in attempts if attempt.pose is not None]
        colours = np.array([COLOURS.get(attempt.status, GREY) for attempt in answers], np.uint8).reshape(-1, 3)
        self._cameras("/answers", [a.pose for a in answers if a.pose is not None], _CAMERA, colours)
        known = [attempt for attempt in answers if attempt.covariance is not None]
        covariances = np.array([a.covariance[:3, :3] for a in known if a.covariance is not None]).reshape(-1, 3, 3)
        axes, lengths = ellipsoids(covariances)
        if known:
            self._put(
                "/ellipsoids",
                self._scene.add_batched_meshes_simple,
                vertices=_BALL.vertices,
                faces=_BALL.faces,
                batched_wxyzs=np.array([quaternion(turn) for turn in axes]),
                batched_positions=np.array([a.pose[:3, 3] for a in known if a.pose is not None]),
                # What has no extent cannot be drawn.
                batched_scales=np.maximum(deviations * lengths, 1e-6 * self._radius),
                batched_colors=linear(np.array([COLOURS.get(attempt.status, GREY) for attempt in known])),
                cast_shadow=False,
            )
        else:
            self._remove("/ellipsoids")
        newest = attempts[-1].candidates if attempts else None
        candidates = [] if newest is None else list(newest)
        self._cameras("/candidates", candidates, _CAMERA, np.array(COLOURS["ambiguous"]))
        self.searched(attempts[-1].searched if attempts else None)

    def visible_deviations(self, attempts: Sequence[Attempt]) -> float:
        """Return by how many standard deviations most ellipsoids can be seen: 1, 2, 5, 10 and so on."""
        sigmas = [np.sqrt(max(np.trace(a.covariance[:3, :3]), 0.0)) for a in attempts if a.covariance is not None]
        sigma = float(np.median(sigmas)) if sigmas else 0.0
        return max(1.0, round_down(_VISIBLE * self._radius / sigma)) if sigma > 0 else 1.0

    def prior(self, prior: Prior | None) -> None:
        """Draw a prior: a camera, or a base with an arrow ahead."""
        if prior is not None and prior.of_base:
            self._lines("/prior", base_box(prior.pose, _BASE * self._radius), np.array(_PRIOR))
        else:
            self._cameras("/prior", [] if prior is None else [prior.pose], 1.5 * _CAMERA, np.array(_PRIOR))

    def chosen(self, pose: np.ndarray | None) -> None:
        """Draw what was chosen among the answers, larger."""
        self._cameras("/chosen", [] if pose is None else [pose], 1.5 * _CAMERA, np.array(_CHOSEN))

    def searched(self, poses: np.ndarray | None) -> None:
        """Draw the views (N, 4, 4) in which an image was looked for."""
        self._cameras("/searched", [] if poses is None else list(poses), _VIEW, np.array(_SEARCHED))

    def index(self, poses: Sequence[np.ndarray]) -> None:
        """Draw the views of the index."""
        self._cameras("/index", poses, _VIEW, np.array(_INDEX))

    def marks(self, points: Sequence[np.ndarray]) -> None:
        """Draw points (3,) that were clicked."""
        if not points:
            self._remove("/marks")
            return
        self._put(
            "/marks",
            self._scene.add_batched_meshes_simple,
            vertices=_BALL.vertices,
            faces=_BALL.faces,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
            batched_positions=np.array(points),
            batched_scales=np.full(len(points), _MARK_SIZE * self._radius),
            batched_colors=linear(np.tile(_MARK, (len(points), 1))),
            cast_shadow=False,
        )

    def _cameras(self, name: str, poses: Sequence[np.ndarray], size: float, colours: np.ndarray) -> None:
        """Draw cameras at poses (4, 4) in one colour (3,), or one each (N, 3)."""
        if not len(poses):
            self._remove(name)
            return
        each = np.broadcast_to(colours, (len(poses), 3)).repeat(EDGES, axis=0)
        self._lines(name, frustums(poses, size * self._radius), each)

    def _lines(self, name: str, lines: np.ndarray, colours: np.ndarray) -> None:
        """Draw lines (N, 2, 3) in one colour (3,), or one each (N, 3)."""
        each = np.broadcast_to(colours, (len(lines), 3))
        self._put(
            name,
            self._scene.add_line_segments,
            points=lines.astype(np.float32),
            colors=linear(np.repeat(each[:, None], 2, axis=1)),
            thickness=2.0,
            thickness_units="screen",
        )

    def _put(self, name: str, add: Callable[..., Any], **properties: Any) -> None:
        self._drawn[name] = add(name, **properties, visible=name.split("/")[1] not in self._hidden)

    def _remove(self, name: str) -> None:
        if name in self._drawn:
            self._drawn.pop(name).remove()


def round_down(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is no more than a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    # What rounding made less than it is.
    return float(power * max(step for step in (1, 2, 5) if step <= value / power * (1 + 1e-9)))


def counts(attempts: Sequence[Attempt]) -> Mapping[str, int]:
    """Return how many attempts ended how, the most frequent first."""
    names = [attempt.status for attempt in attempts]
    return dict(sorted(((name, names.count(name)) for name in set(names)), key=lambda item: (-item[1], item[0])))
