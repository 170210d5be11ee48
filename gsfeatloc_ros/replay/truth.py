"""The true trajectory of the camera, where it was recorded."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable

import numpy as np

from gsfeatloc_ros.common.geometry import interpolate

# Seconds. Between poses farther apart than this the truth is not known.
MAX_GAP = 0.25


class Trajectory:
    """Poses over time.

    Args:
        poses: stamps in nanoseconds with T_map_camera (4, 4), in any order; of two with the same stamp the last counts.
        max_gap: seconds between poses beyond which it is not known what was between them.
    """

    def __init__(self, poses: Iterable[tuple[int, np.ndarray]], max_gap: float = MAX_GAP) -> None:
        self._max_gap = round(1e9 * max_gap)
        by_stamp = dict(poses)
        self._stamps = sorted(by_stamp)
        self._poses = [by_stamp[stamp] for stamp in self._stamps]

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def poses(self) -> np.ndarray:
        """(N, 4, 4), in the order of the stamps."""
        return np.array(self._poses).reshape(-1, 4, 4)

    def at(self, stamp: int) -> np.ndarray | None:
        """Return the pose (4, 4) at a stamp in nanoseconds.

        Between two poses the translation is interpolated linearly and the rotation along the shortest way (slerp). None
        outside the trajectory, and between two poses that are more than the largest gap apart.
        """
        after = bisect_left(self._stamps, stamp)
        if after < len(self) and self._stamps[after] == stamp:
            return self._poses[after]
        if after in (0, len(self)) or self._stamps[after] - self._stamps[after - 1] > self._max_gap:
            return None
        share = (stamp - self._stamps[after - 1]) / (self._stamps[after] - self._stamps[after - 1])
        return interpolate(self._poses[after - 1], self._poses[after], share)
