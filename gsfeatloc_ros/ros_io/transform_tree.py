"""The transforms between frames over time, as tf2 keeps and answers them (geometry2, tf2/src/buffer_core.cpp)."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np

from gsfeatloc_ros.common.geometry import interpolate, invert, make_pose, matrix_from_quaternion
from gsfeatloc_ros.ros_io.decode import nanoseconds
from gsfeatloc_ros.ros_io.message_types import TransformStamped

MAX_WAIT = 0.5
"""Seconds for which one who looks up a transform waits for it: tf may come later than the image of its time."""
# Nanoseconds for which what moves is kept, as tf2 does.
_KEPT = 10 * 10**9


class TransformError(ValueError):
    """A transform that tf does not have, or no tf."""


def unknown_transform(target: str, source: str, stamp: int, why: object) -> TransformError:
    """Return what to raise where tf does not know the frame `source` in `target` at `stamp` (nanoseconds; 0: ever)."""
    when = f"at {stamp // 10**9}.{stamp % 10**9:09d}" if stamp else "at any time"
    return TransformError(
        f"tf has no transform from {source!r} to {target!r} {when} ({why}): correct the names of the "
        "frames, or start what publishes it (ros2 run tf2_tools view_frames shows what there is)"
    )


@dataclass
class _Frame:
    """Where a frame was in its parent: poses T_parent_frame (4, 4) by their stamps in nanoseconds, oldest first."""

    parent: str
    static: bool
    stamps: list[int] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)

    def add(self, stamp: int, pose: np.ndarray) -> None:
        if self.static:
            self.stamps, self.poses = [stamp], [pose]
            return
        place = bisect_left(self.stamps, stamp)
        known = self.stamps[place : place + 1] == [stamp]
        self.stamps[place : place + known] = [stamp]
        self.poses[place : place + known] = [pose]
        old = bisect_left(self.stamps, self.stamps[-1] - _KEPT)
        del self.stamps[:old], self.poses[:old]

    def at(self, stamp: int) -> np.ndarray:
        """Return the pose at a time; raise ValueError outside the time that is known."""
        if self.static:
            return self.poses[0]
        after = bisect_left(self.stamps, stamp)
        if after < len(self.stamps) and self.stamps[after] == stamp:
            return self.poses[after]
        if after in (0, len(self.stamps)):
            past_or_future = "past" if after == 0 else "future"
            raise ValueError(f"{self.parent!r} would have to be extrapolated into the {past_or_future}")
        start, end = self.stamps[after - 1], self.stamps[after]
        return interpolate(self.poses[after - 1], self.poses[after], (stamp - start) / (end - start))


class TransformTree:
    """What tf knows by the messages that it was given."""

    def __init__(self) -> None:
        self._frames: dict[str, _Frame] = {}

    def take(self, transform: TransformStamped, static: bool) -> None:
        """Take a transform of /tf, or of /tf_static; one that tf2 ignores, such as of NaN, is ignored."""
        parent, child = (name.removeprefix("/") for name in (transform.header.frame_id, transform.child_frame_id))
        t, q = transform.transform.translation, transform.transform.rotation
        position, quaternion = np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w])
        usable = np.isfinite(position).all() and np.isfinite(quaternion).all() and quaternion.any()
        if not usable or not parent or not child or parent == child:
            return
        frame = self._frames.get(child)
        if frame is None or (frame.parent, frame.static) != (parent, static):
            frame = self._frames[child] = _Frame(parent, static)
        frame.add(nanoseconds(transform.header.stamp), make_pose(matrix_from_quaternion(quaternion), position))

    def lookup(self, target: str, source: str, stamp: int) -> np.ndarray:
        """Return the pose T_target_source (4, 4) of the frame `source` in the frame `target`.

        Args:
            target: frame into which points are mapped.
            source: frame of which they are.
            stamp: time in nanoseconds; 0 for the newest that all frames between have.

        Raises:
            TransformError: it is not known.
        """
        if target == source:
            return np.eye(4)
        try:
            from_target, from_source = self._ways_to_common(target, source)
            if not stamp:
                moving = [frame.stamps[-1] for frame in (*from_target, *from_source) if not frame.static]
                when = min(moving, default=0)
            else:
                when = stamp
            return invert(_along(from_target, when)) @ _along(from_source, when)
        except ValueError as error:
            raise unknown_transform(target, source, stamp, error) from error

    def _ways_to_common(self, target: str, source: str) -> tuple[list[_Frame], list[_Frame]]:
        """Return the frames from each of two up to the first that both are in, without it."""
        ways = [self._way_up(target), self._way_up(source)]
        common = next((name for name in ways[1] if name in ways[0]), None)
        if common is None:
            raise ValueError(f"{target!r} and {source!r} are not part of the same tree")
        short = [way[: way.index(common)] for way in ways]
        return [self._frames[name] for name in short[0]], [self._frames[name] for name in short[1]]

    def _way_up(self, name: str) -> list[str]:
        """Return a frame's name and those of the frames that it is in, up to the root."""
        way = [name]
        while name in self._frames:
            name = self._frames[name].parent
            if name in way:
                raise ValueError(f"{name!r} is in itself: the tree has a loop")
            way.append(name)
        return way


def _along(way: list[_Frame], stamp: int) -> np.ndarray:
    """Return the pose (4, 4), in what the last frame of a way is in, of the first."""
    pose = np.eye(4)
    for frame in way:
        pose = frame.at(stamp) @ pose
    return pose
