"""The change of the map while the node runs."""

from __future__ import annotations

import os
import threading

from rclpy.node import Node
from rclpy.parameter import Parameter

from gsfeatloc_ros.common.paths import local_path
from gsfeatloc_ros.common.words import in_one_line
from gsfeatloc_ros.localize.engine import Engine, load_renderer
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.node.diagnostics import ERROR, OK, Reporter
from gsfeatloc_ros.node.loading import load
from gsfeatloc_ros.node.parameters import PATH
from gsfeatloc_ros.node.session import Session
from gsfeatloc_ros.ros_io.settings import Settings


class MapChange:
    """Loads another map while the old one serves, and goes back to the old path where the new one cannot be used.

    All but the loading runs in the executor's thread.

    Args:
        node: whose parameter map.path it is.
        reporter: writes to the log and to /diagnostics.
    """

    def __init__(self, node: Node, reporter: Reporter) -> None:
        self._node, self._reporter = node, reporter
        # Path of the map that is being loaded, if any.
        self._loading = ""
        # Whether map.path is being set to that of the old map again.
        self._going_back = False

    def check(self, path: str) -> None:
        """Raise ValueError where map.path cannot be set to `path` now."""
        if self._going_back:
            return
        if self._loading:
            raise ValueError(f"map {self._loading} is being loaded: wait for it")
        if not os.path.exists(local_path(path)):
            raise ValueError(f"map.path: there is no {path!r}")

    def start(self, session: Session, settings: Settings) -> None:
        """Have a session use the map that the settings name, once it is loaded; the same file is read again."""
        if self._going_back:
            return
        self._loading = settings.map.path
        threading.Thread(target=self._load, args=(session, settings), name="map change", daemon=True).start()

    def _load(self, session: Session, settings: Settings) -> None:
        """Load the map beside the executor's thread, and have that use it or go back to the old one."""
        loaded: tuple[Engine, MapSettings] | Exception
        try:
            with session.cores.in_background():
                map_ = load(settings.map.resolved, lambda: not session.closed)
                _check_names(session.settings.map, map_)
                renderer = load(lambda: load_renderer(map_, settings.renderer), lambda: not session.closed)
            loaded = session.engine.with_map(map_.path, renderer), map_
        except Exception as error:  # whatever it is, the old map serves on
            loaded = error
        executor = self._node.executor
        assert executor is not None  # it has set the parameter
        executor.create_task(self._finish, session, loaded)

    def _finish(self, session: Session, loaded: tuple[Engine, MapSettings] | Exception) -> None:
        self._loading = ""
        if session.closed:
            return
        if not isinstance(loaded, Exception):
            engine, map_ = loaded
            session.use_map(engine, map_)
            reason = f"the map is now {engine.map_path}"
            self._node.get_logger().info(reason)
            self._reporter.diagnose("map", OK, reason, {"map": engine.map_path})
            return
        old = session.engine.map_path
        reason = f"the map is still {old}: {in_one_line(loaded)}"
        self._reporter.error(reason)
        self._reporter.diagnose("map", ERROR, reason, {"map": old})
        self._going_back = True
        self._node.set_parameters([Parameter(PATH, value=old)])
        self._going_back = False


def _check_names(old: MapSettings, new: MapSettings) -> None:
    """Raise ValueError where a bundle says other than the map before what holds as long as the node is configured."""
    for name in ("frame_id", "aligned"):
        before, after = getattr(old, name), getattr(new, name)
        if before != after:
            raise ValueError(
                f"parameter map.{name}: it is {before}, and the bundle {new.path} says {after}: start the node with it"
            )
