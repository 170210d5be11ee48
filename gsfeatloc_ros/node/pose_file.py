"""The last good pose, kept in a file for the next start."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.node.diagnostics import Reporter
from gsfeatloc_ros.ros_io.saved_pose import load_pose, save_pose


class PoseFile:
    """Keeps the last good pose in a file, if there is to be one.

    Args:
        path: of the file; empty for none.
        map_: that poses are in.
        reporter: writes to the log.
    """

    def __init__(self, path: str, map_: MapSettings, reporter: Reporter) -> None:
        self._path = Path(path) if path else None
        self._reporter = reporter
        self.use_map(map_)

    def use_map(self, map_: MapSettings) -> None:
        """Keep poses in another map from now on."""
        self._map = asdict(map_)
        del self._map["cache"]  # says nothing of where the map lies
        self._unsaved: np.ndarray | None = None

    def load(self) -> np.ndarray | None:
        """Return the pose (4, 4) T_map_camera of the run before; None where there is none, or none to be used."""
        if self._path is None:
            return None
        try:
            return load_pose(self._path, self._map)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            self._reporter.warn("saved pose", f"state.path: the saved pose is not used: {error}")
            return None

    def take(self, T_map_camera: np.ndarray) -> None:
        """Take a good pose (4, 4), to be saved by and by; from any thread."""
        self._unsaved = T_map_camera

    def save(self) -> None:
        """Save the newest pose, if it is not saved yet; say why where that cannot be done."""
        pose, self._unsaved = self._unsaved, None
        if self._path is None or pose is None:
            return
        try:
            save_pose(self._path, pose, self._map)
        except OSError as error:
            self._reporter.warn("saved pose", f"state.path: the pose cannot be saved: {error}")
