"""What tf knows, as tf2's BufferCore answers it (geometry2, tf2/src/buffer_core.cpp and cache.cpp of Jazzy)."""

from __future__ import annotations

import time as wall
from threading import RLock
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.time import Time

from gsfeatloc_ros.common.geometry import (
    invert,
    make_pose,
    matrix_from_quaternion,
    quaternion_from_matrix,
    so3_exp,
    so3_log,
)
from tf2_ros.exceptions import (
    ConnectivityException,
    ExtrapolationException,
    InvalidArgumentException,
    LookupException,
    TransformException,
)

_CACHE_TIME = 10 * 10**9
_ANY_TIME = 2**63


class _Sample(NamedTuple):
    """Pose of a frame in its parent at a time in nanoseconds."""

    stamp: int
    parent: str
    T_parent_child: np.ndarray


class _Ancestor(NamedTuple):
    """Pose of a frame in one of its ancestors, and the oldest of the newest stamps between the two."""

    T_ancestor_frame: np.ndarray
    stamp: int


class Buffer:
    """The transforms of the last 10 s between any two frames."""

    def __init__(self) -> None:
        self._lock = RLock()
        self._static: dict[str, _Sample] = {}
        self._moving: dict[str, list[_Sample]] = {}  # oldest first
        self._frames: set[str] = set()

    def clear(self) -> None:
        with self._lock:
            for samples in self._moving.values():
                samples.clear()

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        with self._lock:
            if child := self._accept(transform):
                self._static.pop(child, None)
                samples, new = self._moving.get(child, []), _sample(transform)
                if samples:
                    oldest = samples[-1].stamp - _CACHE_TIME
                    samples = [sample for sample in samples if sample.stamp >= oldest]
                    if new.stamp < oldest:
                        return
                self._moving[child] = sorted([*samples, new], key=lambda sample: sample.stamp)

    def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
        with self._lock:
            if child := self._accept(transform):
                self._moving.pop(child, None)
                self._static[child] = _sample(transform)

    def can_transform(
        self,
        target_frame: str,
        source_frame: str,
        time: Time,
        timeout: Duration = Duration(),  # noqa: B008
    ) -> bool:
        deadline = wall.monotonic() + timeout.nanoseconds * 1e-9
        while True:
            try:
                self._lookup(target_frame, source_frame, time.nanoseconds)
            except TransformException:
                if wall.monotonic() >= deadline:
                    return False
            else:
                return True
            wall.sleep(0.02)

    def lookup_transform(
        self,
        target_frame: str,
        source_frame: str,
        time: Time,
        timeout: Duration = Duration(),  # noqa: B008
    ) -> TransformStamped:
        self.can_transform(target_frame, source_frame, time, timeout)
        T_target_source, stamp = self._lookup(target_frame, source_frame, time.nanoseconds)
        message = TransformStamped(child_frame_id=source_frame)
        message.header.frame_id = target_frame
        message.header.stamp = Time(nanoseconds=stamp).to_msg()
        translation, rotation = message.transform.translation, message.transform.rotation
        translation.x, translation.y, translation.z = T_target_source[:3, 3].tolist()
        rotation.x, rotation.y, rotation.z, rotation.w = quaternion_from_matrix(T_target_source[:3, :3]).tolist()
        return message

    def _accept(self, transform: TransformStamped) -> str:
        """Name of the child, or nothing when tf ignores the transform."""
        parent, child = transform.header.frame_id.removeprefix("/"), transform.child_frame_id.removeprefix("/")
        t, q = transform.transform.translation, transform.transform.rotation
        length = np.linalg.norm([q.x, q.y, q.z, q.w])
        if np.isnan([t.x, t.y, t.z]).any() or not np.isfinite(length) or length == 0:
            return ""
        if not parent or not child or parent == child:
            return ""
        self._frames |= {parent, child}
        return child

    def _lookup(self, target: str, source: str, stamp: int) -> tuple[np.ndarray, int]:
        """Pose T_target_source (4, 4) and its stamp; stamp 0 asks for the newest that all frames between have."""
        with self._lock:
            if target == source:
                return np.eye(4), stamp
            for frame in (target, source):
                if not frame or frame.startswith("/"):
                    raise InvalidArgumentException(f"{frame!r} is no name of a frame")
                if frame not in self._frames:
                    raise LookupException(f"frame {frame!r} does not exist")
            of_source, source_problem = self._ancestors(source, stamp)
            of_target, target_problem = self._ancestors(target, stamp)
            common = next((frame for frame in of_source if frame in of_target), None)
            if common is None:
                if stamp and (problem := source_problem or target_problem):
                    raise problem
                raise ConnectivityException(f"{target!r} and {source!r} are not part of the same tree")
            newest = min(of_source[common].stamp, of_target[common].stamp)
            if stamp == 0 and newest != _ANY_TIME:
                return self._lookup(target, source, newest)
            return invert(of_target[common].T_ancestor_frame) @ of_source[common].T_ancestor_frame, stamp

    def _ancestors(self, frame: str, stamp: int) -> tuple[dict[str, _Ancestor], TransformException | None]:
        """The frame and its ancestors, nearest first, and what kept from going on to the root."""
        newest, T_ancestor_frame = _ANY_TIME, np.eye(4)
        found = {frame: _Ancestor(T_ancestor_frame, newest)}
        while frame in self._static or frame in self._moving:
            try:
                sample = self._static.get(frame) or _at(self._moving[frame], stamp, frame)
            except ExtrapolationException as error:
                return found, error
            if sample.parent in found:
                raise LookupException("the tf tree contains a loop")
            if frame in self._moving:
                newest = min(newest, sample.stamp)
            frame, T_ancestor_frame = sample.parent, sample.T_parent_child @ T_ancestor_frame
            found[frame] = _Ancestor(T_ancestor_frame, newest)
        return found, None


def _sample(transform: TransformStamped) -> _Sample:
    t, q = transform.transform.translation, transform.transform.rotation
    pose = make_pose(matrix_from_quaternion([q.x, q.y, q.z, q.w]), [t.x, t.y, t.z])
    stamp = Time.from_msg(transform.header.stamp).nanoseconds
    return _Sample(stamp, transform.header.frame_id.removeprefix("/"), pose)


def _at(samples: list[_Sample], stamp: int, frame: str) -> _Sample:
    """The newest sample for stamp 0, otherwise interpolated between the two around it."""
    if not samples:
        raise ExtrapolationException(f"no data of frame {frame!r}")
    if stamp == 0:
        return samples[-1]
    if not samples[0].stamp <= stamp <= samples[-1].stamp:
        where = "past" if stamp < samples[0].stamp else "future"
        raise ExtrapolationException(f"lookup of frame {frame!r} would require extrapolation into the {where}")
    before = next(sample for sample in reversed(samples) if sample.stamp <= stamp)
    after = next(sample for sample in samples if sample.stamp >= stamp)
    if before.stamp == stamp or before.parent != after.parent:
        return before
    share = (stamp - before.stamp) / (after.stamp - before.stamp)
    start, end = before.T_parent_child, after.T_parent_child
    rotation = start[:3, :3] @ so3_exp(share * so3_log(start[:3, :3].T @ end[:3, :3]))
    return _Sample(stamp, before.parent, make_pose(rotation, (1 - share) * start[:3, 3] + share * end[:3, 3]))
