"""What the node says on /diagnostics: how each attempt ended, and once a second how it is."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.node.qos import RELIABLE

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

# A camera that sends 30 unusable images a second must not flood the log and /diagnostics.
_SECONDS_BETWEEN_COMPLAINTS = 1.0
# Seconds of which rates and shares are told.
_WINDOW = 10.0
# With a smaller share of attempts that end in an answer something is wrong, though not with all.
_USUAL_SHARE = 0.5


def stamp_text(stamp: Time) -> str:
    """A stamp as seconds with nine decimals, exact."""
    return f"{stamp.sec}.{stamp.nanosec:09d}"


def evidence(estimate: Estimate) -> dict[str, str]:
    """What stands behind an estimate, as words for a diagnostic."""
    return {
        "matches": str(estimate.matches),
        "inliers": str(estimate.inliers),
        "inlier_ratio": f"{estimate.inlier_ratio:.3f}",
        "coverage": f"{estimate.coverage:.3f}",
        "agreement": f"{estimate.agreement:.3f}",
        "reprojection_error_px": f"{estimate.reprojection_error:.3f}",
        "passes": str(estimate.passes),
        "views": str(estimate.views),
        **stage_times(estimate),
    }


def stage_times(estimate: Estimate) -> dict[str, str]:
    """Milliseconds by stage, as words for a diagnostic."""
    return {f"ms_{stage}": f"{duration:.1f}" for stage, duration in estimate.milliseconds.items()}


class Reporter:
    """Says things in the log and on /diagnostics, for a node; from any thread."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        self._next_complaint: dict[str, float] = {}

    def complain(self, subject: str, reason: str) -> bool:
        """Log a warning; False when the last one on `subject` was not long enough ago."""
        now = time.monotonic()
        if now < self._next_complaint.get(subject, 0.0):
            return False
        self._next_complaint[subject] = now + _SECONDS_BETWEEN_COMPLAINTS
        self._node.get_logger().warning(reason)
        return True

    def diagnose(self, part: str, level: bytes, message: str, values: dict[str, str]) -> None:
        """Publish the status of a part of the node."""
        name = f"{self._node.get_fully_qualified_name().lstrip('/')}: {part}"
        pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
        array = DiagnosticArray(status=[DiagnosticStatus(level=level, name=name, message=message, values=pairs)])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


@dataclass(frozen=True)
class _Attempt:
    time: float
    status: str
    reason: str
    localized: bool


class Health:
    """How the node has done of late; may be filled and read by different threads.

    Args:
        now: seconds on a clock that runs evenly.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._attempts: deque[_Attempt] = deque(maxlen=1000)
        self._images: deque[float] = deque(maxlen=1000)
        self._stage_times: dict[str, str] = {}

    def saw_image(self) -> None:
        """Count an image that came."""
        self._images.append(self._now())

    def ended(self, status: str, reason: str, estimate: Estimate | None) -> None:
        """Count an attempt, with its estimate if it came to one."""
        self._attempts.append(_Attempt(self._now(), status, reason, estimate is not None and estimate.localized))
        if estimate is not None:
            self._stage_times = stage_times(estimate)

    @property
    def silence(self) -> float:
        """Seconds since the last image; infinite before the first."""
        return self._now() - self._images[-1] if self._images else float("inf")

    def judge(self, image_timeout: float, images_wanted: bool, no_image: str) -> tuple[bytes, str]:
        """Level and one sentence.

        Args:
            image_timeout: seconds without an image after which the camera counts as silent.
            images_wanted: whether the node works on images that come by themselves.
            no_image: what to say while none has come.
        """
        recent = self._recent(self._attempts.copy())
        if images_wanted and not self._images:
            return ERROR, no_image
        if images_wanted and self.silence > image_timeout:
            return ERROR, f"no image for {self.silence:.0f} s: is the camera running?"
        if not recent:
            return OK, "nothing to localize"
        last, answers = recent[-1], sum(attempt.localized for attempt in recent)
        share = f"{answers} of {len(recent)} attempts in {_WINDOW:g} s ended in an answer"
        if last.status in ("refused", "error"):
            return ERROR, last.reason
        if answers < _USUAL_SHARE * len(recent):
            return WARN, f"{share}; the last: {last.reason}"
        return OK, share

    def values(self) -> dict[str, str]:
        """Rates, shares and times for a diagnostic."""
        images, attempts = self._images.copy(), self._attempts.copy()
        recent = self._recent(attempts)
        answers = sum(attempt.localized for attempt in recent)
        since = self._now() - _WINDOW
        return {
            "image_rate": f"{sum(moment > since for moment in images) / _WINDOW:.1f}",
            "attempt_rate": f"{len(recent) / _WINDOW:.1f}",
            "answer_rate": f"{answers / _WINDOW:.1f}",
            "acceptance": f"{answers / len(recent):.2f}" if recent else "nan",
            "last_reason": attempts[-1].reason if attempts else "",
            **self._stage_times,
        }

    def _recent(self, attempts: deque[_Attempt]) -> list[_Attempt]:
        since = self._now() - _WINDOW
        return [attempt for attempt in attempts if attempt.time > since]
