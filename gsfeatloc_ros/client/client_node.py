"""A node for programs that wait for what a localizer says."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import rclpy
from rclpy.executors import SingleThreadedExecutor

# Seconds. Generous: machines may be slow and shared.
TIMEOUT = 60.0


class ClientNode:
    """A node in a context of its own, whose messages are taken while somebody waits for something.

    Args:
        name, namespace: of the node.
        arguments: of ROS: --ros-args with remappings.
    """

    def __init__(self, name: str, namespace: str = "", arguments: Sequence[str] = ()) -> None:
        self._context = rclpy.Context()
        rclpy.init(args=list(arguments), context=self._context)
        self.node = rclpy.create_node(name, context=self._context, namespace=namespace)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def spin_until(self, condition: Callable[[], bool], timeout: float = TIMEOUT) -> bool:
        """Take messages until the condition holds; return False when it does not within `timeout` seconds."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self.spin_once()
        return True

    def spin_once(self, timeout: float = 0.05) -> None:
        """Take a message, if one comes within `timeout` seconds."""
        self._executor.spin_once(timeout_sec=timeout)

    def spin(self, seconds: float) -> None:
        """Take messages for so long."""
        self.spin_until(lambda: False, seconds)
