"""The view index of the map in use: loaded, or built in the background."""

from __future__ import annotations

import threading
import time

from gsfeatloc_ros.common.threads import Cores
from gsfeatloc_ros.localize.engine import Engine
from gsfeatloc_ros.localize.map_index import index_for, index_key
from gsfeatloc_ros.node.attempts import Attempts
from gsfeatloc_ros.node.diagnostics import ERROR, OK, WARN, Reporter
from gsfeatloc_ros.ros_io.settings import Settings

# Seconds between two words on how far it is.
_PROGRESS_PERIOD = 2.0


class IndexBuild:
    """Gives attempts the view index of their map, in a thread of its own, while they go on without.

    Args:
        attempts: that are to use it.
        reporter: writes to the log and to /diagnostics.
        cores: on which it is made, beside the attempts.
    """

    def __init__(self, attempts: Attempts, reporter: Reporter, cores: Cores) -> None:
        self._attempts, self._reporter, self._cores = attempts, reporter, cores
        self._cancelled = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, settings: Settings) -> None:
        """Load or build the index of the map that is in use now; one that is being built for another is given up.

        Args:
            settings: of the node, and of that map.
        """
        self._cancelled.set()
        self._cancelled = threading.Event()
        arguments = (settings, self._attempts.engine, self._cancelled)
        self._thread = threading.Thread(target=self._run, args=arguments, name="indexer", daemon=True)
        self._thread.start()

    def stop(self, timeout: float) -> bool:
        """Give it up; return whether that took no longer than `timeout` seconds."""
        self._cancelled.set()
        if self._thread is None:
            return True
        self._thread.join(timeout)
        return not self._thread.is_alive()

    # In a thread of its own.

    def _run(self, settings: Settings, engine: Engine, cancelled: threading.Event) -> None:
        start, said = time.monotonic(), time.monotonic()

        def progress(done: int, total: int) -> None:
            nonlocal said
            if time.monotonic() >= said + _PROGRESS_PERIOD and not cancelled.is_set():
                said = time.monotonic()
                self._say(OK, f"building the view index: looked from {done} of {total} places", engine, done)

        try:
            with self._cores.in_background():
                key = index_key(engine.map_path, settings.map, settings.matcher, settings.index)
                index = index_for(engine, settings.index, key, progress, cancelled.is_set)
        except Exception as error:  # whatever it is, the node serves on
            if not cancelled.is_set():
                reason = f"no view index, without a prior nothing is found: {error}"
                self._reporter.error(reason)
                self._say(ERROR, reason, engine, 0, log=False)
            return
        if index is None:
            self._say(WARN, "there is no view index, and index.build is false: images need a prior", engine, 0)
        elif not cancelled.is_set():
            self._attempts.use_index(engine, index)
            seconds = time.monotonic() - start
            self._say(OK, f"the view index is ready: {len(index)} views, {seconds:.1f} s", engine, len(index))

    def _say(self, level: bytes, reason: str, engine: Engine, views: int, log: bool = True) -> None:
        if log:
            self._reporter.info(reason)
        self._reporter.diagnose("index", level, reason, {"map": engine.map_path, "views": str(views)})
