"""How the robot has moved of late, by its odometry."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from threading import Lock

import numpy as np

from gsfeatloc_ros.common.geometry import interpolate, invert, so3_log, translation_error
from gsfeatloc_ros.ros_io.growth import Travelled

# Nanoseconds. Farther than this from a message the odometry does not say where the robot was.
_MAX_DISTANCE = 200_000_000
# Nanoseconds. Stamps that go back farther than this are those of another run (a looped bag, a simulation started anew).
_MAX_DISORDER = 1_000_000_000
# Poses. A minute of odometry at 200 Hz; stamps may say that much less time has passed than has.
_MAX_KEPT = 20_000


@dataclass(frozen=True, eq=False)
class Way:
    """How a body went from one place to another.

    Attributes:
        motion: (4, 4) pose of the body at the end in its frame at the start.
        travelled: how long the way was, to the next messages.
    """

    motion: np.ndarray
    travelled: Travelled


class OdometryBuffer:
    """The newest poses of a body in its odometry frame; may be filled and read by different threads.

    Args:
        seconds: how far back they are kept, if that are no more than 20,000.
    """

    def __init__(self, seconds: float) -> None:
        self._kept = int(1e9 * seconds)
        self._lock = Lock()
        self._stamps: list[int] = []
        self._poses: list[np.ndarray] = []
        # How long the way was up to each pose, from one that may be forgotten: distance, turn in radians.
        self._way: list[np.ndarray] = []

    @property
    def newest(self) -> int | None:
        """Stamp of the newest pose in nanoseconds; None where there is none."""
        with self._lock:
            return self._stamps[-1] if self._stamps else None

    def add(self, stamp: int, pose: np.ndarray) -> None:
        """Take the pose T_odom_body (4, 4) at `stamp` (nanoseconds); one that comes out of order is left out."""
        with self._lock:
            if self._stamps and stamp < self._stamps[-1] - _MAX_DISORDER:
                self._stamps, self._poses, self._way = [], [], []
            if self._stamps and stamp <= self._stamps[-1]:
                return
            self._way.append(self._way[-1] + _step(self._poses[-1], pose) if self._way else np.zeros(2))
            self._stamps.append(stamp)
            self._poses.append(pose)
            # Seldom, for it moves all that stays.
            if self._stamps[0] < stamp - 2 * self._kept or len(self._stamps) > 2 * _MAX_KEPT:
                first = max(bisect_left(self._stamps, stamp - self._kept), len(self._stamps) - _MAX_KEPT)
                del self._stamps[:first], self._poses[:first], self._way[:first]

    def forget_after(self, stamp: int) -> None:
        """Forget what is stamped later than `stamp` (nanoseconds)."""
        with self._lock:
            end = bisect_left(self._stamps, stamp)
            del self._stamps[end:], self._poses[end:], self._way[end:]

    def between(self, start: int, end: int) -> Way | None:
        """Return how the body went from where it was at `start` to where it was at `end` (nanoseconds).

        None where it is not known, because nothing came near one of the two times.
        """
        with self._lock:
            at_start, at_end = self._at(start), self._at(end)
            if at_start is None or at_end is None:
                return None
            last = len(self._stamps) - 1
            first, second = (self._way[min(bisect_left(self._stamps, stamp), last)] for stamp in (start, end))
        distance, turn = np.abs(second - first).tolist()
        return Way(invert(at_start) @ at_end, Travelled(distance, turn))

    def pose(self, stamp: int) -> np.ndarray | None:
        """Return the pose T_odom_body (4, 4) at `stamp` (nanoseconds); None as of `between`."""
        with self._lock:
            return self._at(stamp)

    def velocity(self, stamp: int) -> np.ndarray | None:
        """Return how the body moves at `stamp` (nanoseconds): (6,) metres and radians a second, in its own axes.

        It is that between the poses before and after, or the two nearest. None where these are not near.
        """
        with self._lock:
            after = min(max(bisect_left(self._stamps, stamp), 1), len(self._stamps) - 1)
            if after < 1 or max(abs(self._stamps[i] - stamp) for i in (after - 1, after)) > _MAX_DISTANCE:
                return None
            motion = invert(self._poses[after - 1]) @ self._poses[after]
            seconds = 1e-9 * (self._stamps[after] - self._stamps[after - 1])
        return np.concatenate([motion[:3, 3], so3_log(motion[:3, :3])]) / seconds

    def _at(self, stamp: int) -> np.ndarray | None:
        after = bisect_left(self._stamps, stamp)
        if 0 < after < len(self._stamps):
            low, high = self._stamps[after - 1], self._stamps[after]
            if high - low <= 2 * _MAX_DISTANCE:
                return interpolate(self._poses[after - 1], self._poses[after], (stamp - low) / (high - low))
        neighbours = [i for i in (after - 1, after) if 0 <= i < len(self._stamps)]
        nearest = min(neighbours, key=lambda i: abs(self._stamps[i] - stamp), default=None)
        if nearest is None or abs(self._stamps[nearest] - stamp) > _MAX_DISTANCE:
            return None
        return self._poses[nearest]


def _step(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return distance and turn in radians (2,) from one pose (4, 4) to another."""
    return np.array([translation_error(a, b), np.linalg.norm(so3_log(a[:3, :3].T @ b[:3, :3]))])
