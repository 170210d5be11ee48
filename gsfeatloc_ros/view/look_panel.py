"""The panel by which one says what is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from viser import GuiEvent, ViserServer

from gsfeatloc_ros.view.drawing import Drawing
from gsfeatloc_ros.view.words import plain

# Groups of the drawing, what they are called, and whether they are seen at first.
_GROUPS = {
    "map": ("Map", True),
    "axes": ("Axes of the frame", True),
    "floor": ("Floor, z = 0", True),
    "answers": ("Answers", True),
    "ellipsoids": ("Ellipsoids of the answers", True),
    "candidates": ("Candidates of the newest, if ambiguous", True),
    "prior": ("Prior", True),
    "searched": ("Views in which the newest was looked for", True),
    "index": ("Views of the index", False),
}


class LookPanel:
    """Shows and hides groups of the drawing, and says how large ellipsoids are.

    Args:
        server: of the page.
        drawing: what is shown.
        about: the map: what there is to say of it, by name.
        on_deviations: called with the number of standard deviations that ellipsoids are to have.
    """

    def __init__(
        self,
        server: ViserServer,
        drawing: Drawing,
        about: Mapping[str, str],
        on_deviations: Callable[[float], None],
    ) -> None:
        self._drawing, gui = drawing, server.gui
        gui.add_markdown("  \n".join(f"**{plain(name)}** {plain(value)}" for name, value in about.items()))
        for group, (label, shown) in _GROUPS.items():
            drawing.show(group, shown)
            box = gui.add_checkbox(label, shown)
            box.on_update(partial(self._toggle, group))
        self._deviations = gui.add_number("Ellipsoids: standard deviations", 1.0, min=0.1, max=1e6)
        self._deviations.on_update(lambda event: on_deviations(event.target.value))

    def _toggle(self, group: str, event: GuiEvent) -> None:
        self._drawing.show(group, event.target.value)

    def set_deviations(self, deviations: float) -> None:
        """Say that ellipsoids are drawn with so many standard deviations."""
        self._deviations.value = deviations  # type: ignore[misc] # it has a setter, in a base
