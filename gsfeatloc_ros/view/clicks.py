"""Points of the map that are asked for, one click after another."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
from viser import SceneClickEvent, ViserServer

from gsfeatloc_ros.render import Renderer
from gsfeatloc_ros.view.drawing import Drawing
from gsfeatloc_ros.view.picking import point_on_map

# Takes the points (N, 3) that were clicked, and from where (3,) the last was.
Then = Callable[[np.ndarray, np.ndarray], None]


class Clicks:
    """Asks for points, marks them, and hands them on.

    Args:
        server: whose scene is clicked.
        renderer: of the map.
        drawing: that marks them.
        say: shows a text to the user.
    """

    def __init__(self, server: ViserServer, renderer: Renderer, drawing: Drawing, say: Callable[[str], None]) -> None:
        self._server, self._renderer, self._drawing, self._say = server, renderer, drawing, say
        self._lock = threading.Lock()
        self._points: list[np.ndarray] = []
        self._wanted, self._then, self._asking = 0, None, ""

    _then: Then | None

    def ask(self, what: str, count: int, then: Then) -> None:
        """Ask for points; what was asked for before is given up.

        Args:
            what: is to be clicked, for the user.
            count: of the points.
            then: is called with them.
        """
        self.stop()
        with self._lock:
            self._wanted, self._then, self._asking = count, then, what
        self._server.scene.on_click()(self._on_click)
        self._say(f"{what}: 0 of {count} clicked")

    def stop(self) -> None:
        """Give up what was asked for."""
        with self._lock:
            self._points, self._wanted, self._then = [], 0, None
        self._drawing.marks([])
        self._server.scene.remove_click_callback()

    def _on_click(self, event: SceneClickEvent) -> None:
        origin = np.array(event.ray_origin)
        with self._lock:
            if self._then is None:
                return
            point = point_on_map(self._renderer, origin, np.array(event.ray_direction))
            if point is None:
                self._say(f"{self._asking}: the map shows no surface there")
                return
            self._points.append(point)
            self._drawing.marks(self._points)
            points, then = np.array(self._points), self._then
            if len(points) < self._wanted:
                self._say(f"{self._asking}: {len(points)} of {self._wanted} clicked")
                return
        self.stop()
        then(points, origin)
