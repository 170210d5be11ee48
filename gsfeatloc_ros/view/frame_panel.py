"""The panel by which the map's frame is set: up, floor and scale."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from viser import ViserServer

from gsfeatloc_ros.common.parameter import values_of
from gsfeatloc_ros.common.words import in_one_line
from gsfeatloc_ros.localize.settings import PLACE, MapSettings
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.view.clicks import Clicks
from gsfeatloc_ros.view.drawing import Drawing
from gsfeatloc_ros.view.placing import Placing
from gsfeatloc_ros.view.words import plain

_ABOUT = (
    "Where the map lies in the robot's frame, as `gsfeatloc align` writes it: metres, z up, the floor at z = 0. Axes "
    "and floor are drawn where that frame is."
)


class FramePanel:
    """Sets floor and scale by points of the map, and writes the node's parameters.

    Args:
        server: of the page.
        map_: as it is shown.
        clicks: asks for points.
        drawing: shows the frame.
        out: file to write; None for none.
    """

    def __init__(
        self, server: ViserServer, map_: MapSettings, clicks: Clicks, drawing: Drawing, out: Path | None
    ) -> None:
        self._map, self._clicks, self._drawing, self._out = map_, clicks, drawing, out
        self._placing = Placing(map_)
        gui = server.gui
        gui.add_markdown(_ABOUT)
        self._metres = gui.add_checkbox("The unit is the metre", map_.aligned)
        gui.add_button("Floor: click three points").on_click(lambda _: self._ask_floor())
        self._finder = gui.add_button("Floor: find it in the map")
        self._finder.on_click(lambda _: self._try(self._find_floor))
        self._distance = gui.add_number("Distance, metres", 1.0, min=1e-3, step=1e-3)
        gui.add_button("Scale: click two points so far apart").on_click(lambda _: self._ask_scale())
        gui.add_button("Begin anew", color="gray").on_click(lambda _: self._reset())
        label = "Start with --out FILE to write it" if out is None else f"Write {out.name}"
        writer = gui.add_button(label, disabled=out is None, color="green")
        writer.on_click(lambda _: self._try(self._write))
        self._said = gui.add_markdown("")
        self._parameters = gui.add_markdown("")
        self._show()

    def say(self, text: str) -> None:
        """Show a text that may come from elsewhere."""
        self._said.content = f"**{plain(text)}**"

    def _ask_floor(self) -> None:
        def then(points: np.ndarray, seen_from: np.ndarray) -> None:
            self._try(lambda: self._placing.set_floor(points, seen_from, self._metres.value))

        self._clicks.ask("three points on the floor, far apart", 3, then)

    def _ask_scale(self) -> None:
        def then(points: np.ndarray, seen_from: np.ndarray) -> None:
            self._try(lambda: self._placing.set_scale(points[0], points[1], self._distance.value))

        self._clicks.ask("two points whose distance is known", 2, then)

    def _find_floor(self) -> None:
        self.say("looking at the map from all sides: some seconds")
        self._finder.disabled = True
        try:
            gaussian_map = load_map(self._map.path, self._map.alignment(), self._map.reading)
            self._placing.find_floor(gaussian_map, self._metres.value)
        finally:
            self._finder.disabled = False

    def _write(self) -> None:
        assert self._out is not None
        self._placing.write(self._out)
        self.say(f"wrote {self._out}")

    def _reset(self) -> None:
        self._clicks.stop()
        self._placing.reset()
        self.say("as the map is shown")
        self._show()

    def _try(self, step: Callable[[], None]) -> None:
        """Take a step; say why where it cannot be taken."""
        try:
            before = len(self._placing.report)
            step()
            if len(self._placing.report) > before:
                self.say("; ".join(self._placing.report[before:]))
            self._show()
        except (ValueError, OSError) as error:
            self.say(in_one_line(error))

    def _show(self) -> None:
        cell = self._drawing.frame(self._placing.S_robot_shown.inverse())
        values = values_of(self._placing.settings(), "map.")
        lines = [f"A cell of the floor: {cell:g}", *(f"{name}: {_short(values[name])}" for name in PLACE)]
        self._parameters.content = "  \n".join(map(plain, lines))


def _short(value: object) -> str:
    if isinstance(value, tuple):
        return " ".join(f"{number:.4g}" for number in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value).lower()
