"""Look up transforms in tf, and broadcast one. tf2_ros is imported when first needed: the localizer runs without."""

from __future__ import annotations

import time
from types import ModuleType
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.time import Time as RclpyTime

from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion, quaternion_from_matrix
from gsfeatloc_ros.ros_io.transform_tree import MAX_WAIT, TransformError, unknown_transform

# Seconds between two looks at what has come meanwhile.
_POLL_PERIOD = 0.01


class Transforms:
    """Listens to /tf and /tf_static once `listen` was called, and broadcasts on /tf.

    The node's executor takes the messages, in its own thread; `lookup` may wait for them in another.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._buffer: Any = None
        self._broadcaster: Any = None

    def listen(self) -> None:
        """Begin to listen to tf; nothing more happens when called again.

        Raises:
            TransformError: tf2_ros is not installed.
        """
        if self._buffer is None:
            tf2_ros = _import_tf2_ros()
            self._buffer = tf2_ros.Buffer()
            self._listener = tf2_ros.TransformListener(self._buffer, self._node)

    def lookup(self, target: str, source: str, stamp: int, timeout: float = MAX_WAIT) -> np.ndarray:
        """Return the pose T_target_source (4, 4) of the frame `source` in the frame `target`.

        What is not there yet is waited for, in seconds of the wall clock: the node's own may stand still. Not to be
        called in the executor's thread with a timeout, where nothing can come meanwhile.

        Args:
            target: frame into which points are mapped.
            source: frame of which they are; of the same name as `target`, the answer is the identity, without tf.
            stamp: time in nanoseconds; 0 for the newest that tf has.
            timeout: seconds to wait.

        Raises:
            TransformError: tf does not have it within the timeout, or it is not finite; tf2_ros is not installed.
        """
        if target == source:
            return np.eye(4)
        self.listen()
        tf2_ros = _import_tf2_ros()
        deadline = time.monotonic() + timeout
        while True:
            try:
                found = self._buffer.lookup_transform(target, source, RclpyTime(nanoseconds=stamp))
                return _pose(found)
            except tf2_ros.TransformException as error:
                if time.monotonic() >= deadline:
                    raise unknown_transform(target, source, stamp, error) from error
            time.sleep(_POLL_PERIOD)

    def broadcast(self, parent: str, child: str, T_parent_child: np.ndarray, stamp: Time) -> None:
        """Broadcast the pose T_parent_child (4, 4) of the frame `child` in the frame `parent` at a time.

        Raises:
            TransformError: tf2_ros is not installed.
        """
        if self._broadcaster is None:
            self._broadcaster = _import_tf2_ros().TransformBroadcaster(self._node)
        message = TransformStamped(child_frame_id=child)
        message.header.frame_id, message.header.stamp = parent, stamp
        translation, rotation = message.transform.translation, message.transform.rotation
        translation.x, translation.y, translation.z = T_parent_child[:3, 3].tolist()
        rotation.x, rotation.y, rotation.z, rotation.w = quaternion_from_matrix(T_parent_child[:3, :3]).tolist()
        self._broadcaster.sendTransform(message)

    def forget(self) -> None:
        """Forget what /tf has said, for when time has jumped back; what /tf_static has said stays."""
        if self._buffer is not None:
            self._buffer.clear()


def _import_tf2_ros() -> ModuleType:
    try:
        import tf2_ros
    except ImportError as error:
        raise TransformError(
            f"tf needs tf2_ros, which is not installed: apt install ros-jazzy-tf2-ros-py ({error})"
        ) from error
    return tf2_ros


def _pose(message: TransformStamped) -> np.ndarray:
    """Return the pose T_target_source (4, 4); tf refuses NaN, but not infinite values."""
    translation, rotation = message.transform.translation, message.transform.rotation
    position = np.array([translation.x, translation.y, translation.z])
    if not np.isfinite(position).all():
        raise TransformError(
            f"tf's transform from {message.child_frame_id!r} to {message.header.frame_id!r} has translation "
            f"{position.tolist()}: all must be finite"
        )
    quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    return make_pose(matrix_from_quaternion(quaternion), position)
