"""What is said of the state: on ~/state, latched, and on /diagnostics."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from gsfeatloc_ros.node.diagnostics import ERROR, OK, WARN, Reporter, status_message
from gsfeatloc_ros.node.qos import LAST, overridable
from gsfeatloc_ros.ros_io.state import LocalizationState, Standing, State

_LEVELS = {State.LOCALIZED: OK, State.COASTING: WARN, State.LOST: ERROR}


class StandingPublisher:
    """Publishes where the robot stands; from any thread.

    A DiagnosticStatus is what monitors and behaviour trees can read without a package of this one's; its level says how
    bad it is, its message is the state, its values tell why and for how long.

    Args:
        node: whose topic it is.
        state: that is published.
        reporter: writes to the log and to /diagnostics.
        withheld: why no transform is broadcast although the robot is localized; empty where one is.
    """

    def __init__(self, node: Node, state: LocalizationState, reporter: Reporter, withheld: Callable[[], str]) -> None:
        self._node, self._state, self._reporter, self._withheld = node, state, reporter, withheld
        self._publisher = node.create_publisher(DiagnosticStatus, "~/state", LAST, qos_overriding_options=overridable())
        self._lock = Lock()
        self._last: State | None = None

    def publish_change(self) -> None:
        """Publish the state if it is another one than was published last."""
        with self._lock:
            standing = self._state.standing()
            if standing.state is not self._last:
                self._publish(standing)

    def publish(self) -> None:
        """Publish the state, and how long it has lasted."""
        with self._lock:
            self._publish(self._state.standing())

    def close(self) -> None:
        """Publish nothing more."""
        self._node.destroy_publisher(self._publisher)

    def _publish(self, standing: Standing) -> None:
        # Coasting comes and goes.
        if standing.state is not self._last and State.LOST in (standing.state, self._last):
            self._reporter.info(f"{standing.state.value}: {standing.reason}")
        self._last = standing.state
        withheld, level = self._withheld(), _LEVELS[standing.state]
        reason = f"{standing.reason}; no transform is broadcast: {withheld}" if withheld else standing.reason
        values = {
            "reason": reason,
            "seconds": f"{standing.seconds:.1f}",
            "failures": str(standing.failures),
        }
        state = standing.state.value
        if withheld and level == OK:
            level = WARN
        self._publisher.publish(status_message(self._node, "state", level, state, values))
        self._reporter.diagnose("state", level, f"{state}: {reason}", {"state": state} | values)
