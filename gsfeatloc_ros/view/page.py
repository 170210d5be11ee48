"""The page: the map, what came of images in it, and panels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsfeatloc_ros.index import IndexOptions
from gsfeatloc_ros.index.placement import radius
from gsfeatloc_ros.index.storage import index_path, load_index
from gsfeatloc_ros.inspect.looks import look_around
from gsfeatloc_ros.localize.map_index import index_key
from gsfeatloc_ros.localize.settings import MapSettings, MatcherSettings
from gsfeatloc_ros.maps import GaussianMap
from gsfeatloc_ros.match import MATCHERS
from gsfeatloc_ros.render import Renderer
from gsfeatloc_ros.view.answers_panel import AnswersPanel
from gsfeatloc_ros.view.clicks import Clicks
from gsfeatloc_ros.view.drawing import Drawing
from gsfeatloc_ros.view.frame_panel import FramePanel
from gsfeatloc_ros.view.look_panel import LookPanel
from gsfeatloc_ros.view.prior_panel import PriorPanel, PriorSender
from gsfeatloc_ros.view.server import PageServer
from gsfeatloc_ros.view.splats import thinned_splats
from gsfeatloc_ros.view.store import Store

# Poses that are tried to find where to stand at first.
_LOOKS = 60
# Of what is drawn, as a share of the map's radius.
_NEAR, _FAR = 1e-3, 100.0


@dataclass(frozen=True)
class PageOptions:
    """How a map is shown.

    Attributes:
        gaussians: that are drawn at most.
        out: parameter file that the page may write; None for none.
    """

    gaussians: int
    out: Path | None


class Page:
    """What a browser shows; its methods are called from one thread.

    Args:
        server: of the page.
        map_: where the map lies.
        gaussian_map: the same, read.
        renderer: of it.
        store: what came of images.
    """

    def __init__(
        self, server: PageServer, map_: MapSettings, gaussian_map: GaussianMap, renderer: Renderer, store: Store
    ) -> None:
        self._server, self._map, self._renderer, self._store = server, map_, renderer, store
        self._radius = radius(renderer.solid_points)
        self._drawing = Drawing(server, self._radius)
        self._seen = -1
        self._deviations: float | None = None
        self._count = len(gaussian_map)
        self._gaussian_map = gaussian_map

    def build(self, options: PageOptions, sender: PriorSender | None) -> None:
        """Draw the map and make the panels; the one of priors only with what sends them."""
        splats = thinned_splats(self._gaussian_map, options.gaussians)
        self._drawing.map(splats)
        views = _index_poses(self._map)
        self._drawing.index(views)
        self._stand()
        tabs = self._server.gui.add_tab_group()
        with tabs.add_tab("Show"):
            about = {
                "Map": Path(self._map.path).name,
                "Gaussians": f"{len(splats.centres)} of {self._count}",
                "Views of the index": f"{len(views)}" if views else "none: gsfeatloc index makes them",
            }
            self._look = LookPanel(self._server, self._drawing, about, self._set_deviations)
        with tabs.add_tab("Answers"):
            self._answers = AnswersPanel(self._server, self._store, self._renderer, self._drawing)
        clicks = Clicks(self._server, self._renderer, self._drawing, self._say)
        with tabs.add_tab("Frame"):
            self._frame = FramePanel(self._server, self._map, clicks, self._drawing, options.out)
        self._prior: PriorPanel | None = None
        if sender is not None:
            with tabs.add_tab("Prior"):
                self._prior = PriorPanel(self._server, clicks, sender)

    def update(self) -> None:
        """Show what came since the last time."""
        changes = self._store.changes
        if changes == self._seen:
            return
        self._seen = changes
        attempts = self._store.attempts()
        if self._deviations is None and any(attempt.covariance is not None for attempt in attempts):
            # It draws them too.
            self._look.set_deviations(self._drawing.visible_deviations(attempts))
        else:
            self._drawing.attempts(attempts, self._deviations or 1.0)
        if self._store.newest_prior is not None:
            self._drawing.prior(self._store.newest_prior)
        self._answers.update()

    def _set_deviations(self, deviations: float) -> None:
        self._deviations = deviations
        self._drawing.attempts(self._store.attempts(), deviations)

    def _say(self, text: str) -> None:
        """Say to the user what is to be clicked, where the buttons for that are."""
        self._frame.say(text)
        if self._prior is not None:
            self._prior.say(text)

    def _stand(self) -> None:
        """Let those who come stand where much of the map is seen."""
        looks = look_around(self._renderer, _LOOKS)
        camera = self._server.initial_camera
        camera.near, camera.far = _NEAR * self._radius, _FAR * self._radius
        if looks:
            pose = max(looks, key=lambda look: len(look.cells)).pose
            camera.position, camera.look_at = pose[:3, 3], pose[:3, 3] + 0.3 * self._radius * pose[:3, 2]


def _index_poses(map_: MapSettings) -> list[np.ndarray]:
    """Return the poses of the index of a map, if there is one that can be read."""
    try:
        path, key = index_path(map_.path), index_key(map_.path, map_, MatcherSettings(), IndexOptions())
        # Whatever features it has, where it looks from is the same.
        found = (load_index(path, key | {"matcher": [name, ""]}) for name in MATCHERS)
        index = next((index for index in found if index is not None), None)
    except (ValueError, OSError):
        return []
    return [] if index is None else list(index.poses)
