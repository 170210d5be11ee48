"""What a session reports: how each attempt ended, what was refused, and once a second how it has done of late."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Time

from gsfeatloc_ros.crosscheck.fit import Cause
from gsfeatloc_ros.node.diagnostics import (
    ERROR,
    LEVELS,
    OK,
    WARN,
    Reporter,
    estimate_texts,
    stage_texts,
    stamp_text,
)
from gsfeatloc_ros.ros_io.camera_health import CameraHealth
from gsfeatloc_ros.ros_io.cross_check import CrossCheck
from gsfeatloc_ros.ros_io.outcome import Outcome, OutcomeStatus

# Seconds over which rates and shares are counted, and most images and attempts in them.
_WINDOW = 10.0
_MAX_COUNTED = 1000
# With a smaller share of attempts that end in an answer something is wrong, though not with all.
_MIN_USUAL_SHARE = 0.5


@dataclass(frozen=True)
class _Attempt:
    time: float
    status: OutcomeStatus
    reason: str


class Health:
    """How a session has done of late; may be filled and read by different threads.

    Args:
        now: seconds on a clock that runs evenly.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._attempts: deque[_Attempt] = deque(maxlen=_MAX_COUNTED)
        self._images: deque[float] = deque(maxlen=_MAX_COUNTED)
        self._unserved: deque[float] = deque(maxlen=_MAX_COUNTED)
        # When answers were published, and seconds from their images' stamps to that.
        self._latencies: deque[tuple[float, float]] = deque(maxlen=_MAX_COUNTED)
        self._stage_texts: dict[str, str] = {}

    def count_image(self) -> None:
        """Count an image that came."""
        self._images.append(self._now())

    def count_unserved(self) -> None:
        """Count a request that was told that the node is busy."""
        self._unserved.append(self._now())

    def count_attempt(self, outcome: Outcome) -> None:
        """Count what came of an image."""
        self._attempts.append(_Attempt(self._now(), outcome.status, outcome.reason))
        if outcome.estimate is not None:
            self._stage_texts = stage_texts(outcome.estimate)

    def count_answer(self, latency: float) -> None:
        """Count an answer so many seconds after its image's stamp; NaN where that has none."""
        if not math.isnan(latency):
            self._latencies.append((self._now(), latency))

    @property
    def silence(self) -> float:
        """Seconds since the last image; infinite before the first."""
        return self._now() - self._images[-1] if self._images else float("inf")

    def assess(self, image_timeout: float, images_wanted: bool, no_image: str) -> tuple[bytes, str]:
        """Return the level, and one sentence.

        Args:
            image_timeout: seconds without an image after which the camera counts as silent.
            images_wanted: whether the node works on images that come by themselves.
            no_image: what to say while none has come.
        """
        recent = self._recent()
        if images_wanted and not self._images:
            return ERROR, no_image
        if images_wanted and self.silence > image_timeout:
            return ERROR, f"no image for {self.silence:.0f} s: is the camera running?"
        unserved = sum(moment > self._now() - _WINDOW for moment in self._unserved.copy())
        if unserved:
            return WARN, f"busy: {unserved} requests of the last {_WINDOW:g} s were not served: ask less often"
        if not recent:
            return OK, "nothing to localize"
        last, answers = recent[-1], _answers(recent)
        share = f"{answers} of {len(recent)} attempts in {_WINDOW:g} s ended in an answer"
        if last.status in (OutcomeStatus.REFUSED, OutcomeStatus.ERROR):
            return ERROR, last.reason
        if answers < _MIN_USUAL_SHARE * len(recent):
            return WARN, f"{share}; the last: {last.reason}"
        return OK, share

    def texts(self) -> dict[str, str]:
        """Return rates, shares and times by key."""
        images, attempts, recent = self._images.copy(), self._attempts.copy(), self._recent()
        answers, since = _answers(recent), self._now() - _WINDOW
        latencies = [1e3 * latency for moment, latency in self._latencies.copy() if moment > since]
        median, most = np.percentile(latencies, [50, 95]) if latencies else (math.nan, math.nan)
        return {
            "image_rate": f"{sum(moment > since for moment in images) / _WINDOW:.1f}",
            "attempt_rate": f"{len(recent) / _WINDOW:.1f}",
            "answer_rate": f"{answers / _WINDOW:.1f}",
            "acceptance": f"{answers / len(recent):.2f}" if recent else "nan",
            "latency_ms_median": f"{median:.1f}",
            "latency_ms_95_percent": f"{most:.1f}",
            "last_reason": attempts[-1].reason if attempts else "",
            **self._stage_texts,
        }

    def _recent(self) -> list[_Attempt]:
        since = self._now() - _WINDOW
        return [attempt for attempt in self._attempts.copy() if attempt.time > since]


def _answers(attempts: list[_Attempt]) -> int:
    return sum(attempt.status is OutcomeStatus.LOCALIZED for attempt in attempts)


class Report:
    """What a session reports; from any thread.

    Args:
        reporter: that writes it.
        dropped: number of images that gave way to others.
        camera: what is known of the calibration of the camera on the topic.
        cross_check: of the answers by odometry.

    Attributes:
        health: of the session.
        camera, cross_check: see there.
        images: number of images that came.
        answers: number of answers that were published.
    """

    def __init__(
        self, reporter: Reporter, dropped: Callable[[], int], camera: CameraHealth, cross_check: CrossCheck
    ) -> None:
        self._reporter, self.camera, self.cross_check = reporter, camera, cross_check
        self._dropped = dropped
        self.health = Health()
        self._said = ""
        self.images = 0
        self.answers = 0

    @property
    def wrong_scale(self) -> str:
        """What odometry says of a scale of the map that it contradicts; empty where it does not."""
        return self._wrong()[1] if self._wrong()[0] == Cause.SCALE.value else ""

    def count_image(self) -> None:
        """Count an image that came."""
        self.images += 1
        self.health.count_image()

    def count_answer(self, latency: float) -> None:
        """Count an answer that was published so many seconds after its image's stamp; NaN where that has none."""
        self.answers += 1
        self.health.count_answer(latency)

    def count_unserved(self, service: str, reason: str) -> None:
        """Count and log a request that was told that the node is busy."""
        self.health.count_unserved()
        self._reporter.warn("busy", f"{service}: {reason}")

    def publish_ready(self, reason: str) -> None:
        """Publish that the session has begun."""
        self._diagnose(OK, "ready", reason, {})

    def refuse(self, subject: str, reason: str, stamp: Time | None = None) -> None:
        """Log and publish why what came on a topic cannot be used, not more often than is useful."""
        if self._reporter.warn(subject, reason):
            stamped = {"stamp": stamp_text(stamp)} if stamp else {}
            self._diagnose(ERROR, OutcomeStatus.REFUSED.value, reason, stamped)

    def publish_attempt(self, stamp: Time, outcome: Outcome, about: dict[str, str], traceback: str = "") -> None:
        """Publish, and log unless it ended well, what came of the image of a stamp.

        Args:
            stamp: of the image.
            outcome: what came of it.
            about: what else there is to know, by key.
            traceback: of the exception, if that is what came of it.
        """
        if outcome.status is OutcomeStatus.ERROR:
            self._reporter.error(f"localizing the image of {stamp_text(stamp)} failed\n{traceback}")
        elif not outcome.localized:
            self._reporter.warn(outcome.status.value, outcome.reason)
        self.health.count_attempt(outcome)
        texts = {} if outcome.estimate is None else estimate_texts(outcome.estimate)
        values = {"stamp": stamp_text(stamp)} | texts | about
        self._diagnose(LEVELS[outcome.status], outcome.status.value, outcome.reason, values)

    def note(self, reason: str) -> None:
        """Log what is remarkable about an answer: the robot was found again, or its pose jumps."""
        self._reporter.warn("note", reason)

    def publish_health(self, level: bytes, reason: str, about: dict[str, str]) -> None:
        """Publish how the session does, with what there is to know about it; a wrong calibration explains much."""
        subject, warning = self._wrong()
        if subject != self._said:
            self._said = subject
            self._reporter.say(warning or "what did not fit the camera or the odometry fits now")
        if warning and level != ERROR:
            level, reason = WARN, warning
        texts = about | self.health.texts() | self.camera.texts() | self.cross_check.texts()
        self._reporter.diagnose("health", level, reason, texts | self._counts)

    def _wrong(self) -> tuple[str, str]:
        """Return the subject of what is wrong with what was declared, and a sentence; empty where nothing is.

        A wrong focal length moves all answers, and explains whatever odometry says of them.
        """
        if self.camera.warning:
            return "focal length", self.camera.warning
        cause = self.cross_check.cause
        return ("", "") if cause is None else (cause.value, self.cross_check.warning)

    def _diagnose(self, level: bytes, status: str, reason: str, values: dict[str, str]) -> None:
        said = {"status": status, "reason": reason}
        self._reporter.diagnose("localization", level, reason, said | values | self._counts)

    @property
    def _counts(self) -> dict[str, str]:
        return {
            "images_received": str(self.images),
            "images_dropped": str(self._dropped()),
            "answers": str(self.answers),
        }
