"""The node's statuses on /diagnostics, and its warnings in the log."""

from __future__ import annotations

import math
import time
import traceback

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from gsfeatloc_ros.common.words import in_one_line, shortened
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.localize.protection import ProtectionLevel
from gsfeatloc_ros.node.qos import RELIABLE
from gsfeatloc_ros.ros_io.growth import position_sigma, rotation_sigma
from gsfeatloc_ros.ros_io.inputs import LocalizerInput
from gsfeatloc_ros.ros_io.outcome import OutcomeStatus

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

LEVELS = {
    OutcomeStatus.LOCALIZED: OK,
    OutcomeStatus.REJECTED: WARN,
    OutcomeStatus.FAILED: WARN,
    OutcomeStatus.AMBIGUOUS: WARN,
    OutcomeStatus.UNCONFIRMED: WARN,
    OutcomeStatus.REFUSED: ERROR,
    OutcomeStatus.BUSY: WARN,
    OutcomeStatus.ERROR: ERROR,
}

# Seconds. A camera that sends 30 unusable images a second must not flood the log and /diagnostics.
_MIN_WARNING_PERIOD = 1.0
# Characters. Traces are long.
_MAX_ERROR_LENGTH = 10_000


def stamp_text(stamp: Time) -> str:
    """Return a stamp as seconds with nine decimals, exact."""
    return f"{stamp.sec}.{stamp.nanosec:09d}"


def estimate_texts(estimate: Estimate) -> dict[str, str]:
    """Return the evidence and the times of an estimate by key."""
    return estimate.evidence.texts() | stage_texts(estimate)


def protection_texts(level: ProtectionLevel) -> dict[str, str]:
    """Return how far an answer may be off, by key: map units, degrees."""
    return {
        "protection_radius": f"{level.radius:.2g}",
        "protection_angle_deg": f"{math.degrees(level.angle):.2g}",
    }


def prior_texts(query: LocalizerInput) -> dict[str, str]:
    """Return what an image was localized with, by key: map units, degrees."""
    source = "none" if query.source is None else query.source.value
    if query.prior_covariance is None:
        return {"prior": source}
    return {
        "prior": source,
        "prior_sigma": f"{position_sigma(query.prior_covariance):.2g}",
        "prior_sigma_deg": f"{math.degrees(rotation_sigma(query.prior_covariance)):.2g}",
    }


def stage_texts(estimate: Estimate) -> dict[str, str]:
    """Return the milliseconds of an estimate's stages by key."""
    return {f"ms_{stage}": f"{duration:.1f}" for stage, duration in estimate.milliseconds.items()}


def status_message(node: Node, part: str, level: bytes, message: str, values: dict[str, str]) -> DiagnosticStatus:
    """Return the status of a part of a node."""
    name = f"{node.get_fully_qualified_name().lstrip('/')}: {part}"
    pairs = [KeyValue(key=key, value=shortened(value)) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, message=shortened(message), values=pairs)


class Reporter:
    """Writes to the log and to /diagnostics for a node; from any thread."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        self._next_warning: dict[str, float] = {}

    def warn(self, subject: str, reason: str) -> bool:
        """Log a warning; do not, and return False, when the last one on `subject` was not long enough ago."""
        if not self._is_due(subject):
            return False
        self._node.get_logger().warning(shortened(reason))
        return True

    def fail(self, error: Exception) -> None:
        """Log and publish an exception that nobody foresaw, when the last one was long enough ago."""
        if self._is_due("failure"):
            reason = in_one_line(error)
            self.error(f"the node goes on after a failure: {reason}\n{''.join(traceback.format_exception(error))}")
            self.diagnose("failure", ERROR, reason, {})

    def say(self, reason: str) -> None:
        """Log a warning, of what is said once."""
        self._node.get_logger().warning(shortened(reason))

    def info(self, reason: str) -> None:
        """Log what is worth knowing."""
        self._node.get_logger().info(shortened(reason))

    def error(self, reason: str) -> None:
        """Log an error, which may hold a trace."""
        self._node.get_logger().error(shortened(reason, _MAX_ERROR_LENGTH))

    def diagnose(self, part: str, level: bytes, message: str, values: dict[str, str]) -> None:
        """Publish the status of a part of the node."""
        array = DiagnosticArray(status=[status_message(self._node, part, level, message, values)])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)

    def _is_due(self, subject: str) -> bool:
        """Return whether the last words on a subject were long enough ago, and note that there are some now."""
        now = time.monotonic()
        if now < self._next_warning.get(subject, 0.0):
            return False
        self._next_warning[subject] = now + _MIN_WARNING_PERIOD
        return True
