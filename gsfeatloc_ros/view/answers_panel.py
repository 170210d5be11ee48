"""The panel with the list of what came of the images: stand where one was, and compare photo and map."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from viser import ClientHandle, GuiEvent, ViserServer

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.render import Renderer
from gsfeatloc_ros.view.attempts import Attempt
from gsfeatloc_ros.view.drawing import COLOURS, GREY, Drawing, counts, quaternion
from gsfeatloc_ros.view.jpeg import decoded
from gsfeatloc_ros.view.recorded import WIDTH, SmallPhoto
from gsfeatloc_ros.view.store import Store
from gsfeatloc_ros.view.words import plain

_ROWS = 6
# Of the map's picture where there is no photo.
_CAMERA = Camera.centred(WIDTH, 3 * WIDTH // 4, 0.7 * WIDTH)


class AnswersPanel:
    """Lists attempts, the newest first.

    Args:
        server: of the page.
        store: what there is to list.
        renderer: of the map.
        drawing: shows which one was chosen.
    """

    def __init__(self, server: ViserServer, store: Store, renderer: Renderer, drawing: Drawing) -> None:
        self._store, self._renderer, self._drawing = store, renderer, drawing
        self._offset = 0
        # What stands on the rows: more attempts may have come by the time that one is pressed.
        self._shown: list[tuple[int, Attempt]] = []
        gui = self._gui = server.gui
        self._summary = gui.add_markdown("No image was tried yet.")
        self._only_without = gui.add_checkbox("Only those without an answer", False)
        self._only_without.on_update(lambda _: self._turn(0))
        self._rows = [gui.add_button("", visible=False) for _ in range(_ROWS)]
        for number, row in enumerate(self._rows):
            row.on_click(partial(self._on_row, number))
        self._pages = gui.add_button_group("Page", ("newer", "older"))
        self._pages.on_click(lambda event: self._turn(_ROWS if event.target.value == "older" else -_ROWS))
        self._details = gui.add_markdown("")
        blank = np.full((3, 4, 3), 255, np.uint8)
        self._photo = gui.add_image(blank, label="Photo", visible=False)
        self._map = gui.add_image(blank, label="The map from there", visible=False)

    def update(self) -> None:
        """Show what came meanwhile."""
        attempts = self._store.attempts()
        if attempts:
            said = ", ".join(f"{count} {name}" for name, count in counts(attempts).items())
            self._summary.content = plain(f"{len(attempts)} images: {said}")
        self._shown = self._listed()[self._offset : self._offset + _ROWS]
        for number, row in enumerate(self._rows):
            row.visible = number < len(self._shown)
            if row.visible:
                place, attempt = self._shown[number]
                row.label = f"{place}: {attempt.seconds} s, {attempt.status}"[:80]
                row.color = COLOURS.get(attempt.status, GREY)

    def _listed(self) -> list[tuple[int, Attempt]]:
        """Return the attempts that are listed, each with its number."""
        numbered = list(enumerate(self._store.attempts(), start=1))[::-1]
        return [item for item in numbered if not (self._only_without.value and item[1].pose is not None)]

    def _turn(self, by: int) -> None:
        """Turn the pages by so many attempts; to the first by none."""
        last = max(0, (len(self._listed()) - 1) // _ROWS * _ROWS)
        self._offset = min(max(self._offset + by, 0), last) if by else 0
        self.update()

    def _on_row(self, row: int, event: GuiEvent) -> None:
        self._choose(row, event.client)

    def _choose(self, row: int, client: ClientHandle | None) -> None:
        shown = self._shown
        if row >= len(shown):
            return
        number, attempt = shown[row]
        prior = self._store.prior(attempt.stamp)
        # A base says nothing of where its camera is.
        seen_from = prior.pose if prior is not None and not prior.of_base else None
        pose = seen_from if attempt.pose is None else attempt.pose
        self._details.content = self._words(number, attempt, seen_from is not None)
        self._drawing.chosen(attempt.pose)
        self._drawing.prior(prior)
        self._drawing.searched(attempt.searched)
        picture = self._store.picture(attempt.stamp)
        camera = picture.camera if isinstance(picture, SmallPhoto) else _CAMERA
        if pose is not None and client is not None:
            _stand(client, pose, camera)
        self._show(self._photo, _pixels(picture), "Photo" if isinstance(picture, SmallPhoto) else "Photo and map")
        drawn = None
        # Beside the node's picture, which has it, there is no need of another.
        if pose is not None and not isinstance(picture, np.ndarray):
            drawn = self._renderer.render(camera, pose).on_host().image()
        origin = "prior" if attempt.pose is None else "answer"
        self._show(self._map, drawn, f"The map from the {origin}")

    def _words(self, number: int, attempt: Attempt, at_prior: bool) -> str:
        lines = [f"**{number}: {plain(attempt.status)}**", plain(attempt.reason)]
        if attempt.pose is not None:
            lines.append(plain("at " + " ".join(f"{value:.3f}" for value in attempt.pose[:3, 3])))
        elif at_prior:
            lines.append("There is no answer: you stand at its prior.")
        if attempt.covariance is not None:
            sigmas = np.sqrt(np.maximum(np.linalg.eigvalsh(attempt.covariance[:3, :3]), 0.0))
            lines.append(plain("standard deviations " + " ".join(f"{sigma:.2g}" for sigma in sigmas)))
        return "  \n".join(lines)

    @staticmethod
    def _show(handle: Any, image: np.ndarray | None, label: str) -> None:
        handle.visible = image is not None
        if image is not None:
            handle.image, handle.label = image, label


def _pixels(picture: SmallPhoto | np.ndarray | None) -> np.ndarray | None:
    """Return the pixels (H, W, 3) uint8 RGB of a photo or an encoded picture."""
    if isinstance(picture, SmallPhoto):
        return picture.pixels()
    return None if picture is None else decoded(picture)


def _stand(client: ClientHandle, pose: np.ndarray, camera: Camera) -> None:
    """Let a client see what a camera at a pose (4, 4) sees."""
    with client.atomic():
        client.camera.position = pose[:3, 3]
        client.camera.wxyz = quaternion(pose[:3, :3])
        client.camera.fov = 2 * float(np.arctan(0.5 * camera.height / camera.K[1, 1]))
