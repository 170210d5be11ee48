"""What came of an image, in the node and in replay."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from gsfeatloc_ros.common.words import shortened
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.ros_io.state import Decision, Judgement


class OutcomeStatus(Enum):
    """How it ended: as the Status of an Estimate, or without one. The value is what people read."""

    LOCALIZED = "localized"
    REJECTED = "rejected"
    FAILED = "failed"
    AMBIGUOUS = "ambiguous"
    UNCONFIRMED = "unconfirmed"
    REFUSED = "refused"
    BUSY = "busy"
    ERROR = "error"


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of an image.

    Attributes:
        status: UNCONFIRMED: a pose was found that another image has to confirm. REFUSED: the image could not be tried.
            BUSY: it was asked for when too many others waited, or could not be served in time. ERROR: a bug met on it,
            or no memory. Otherwise the estimate's.
        reason: one sentence.
        estimate: None if the image could not be tried.
    """

    status: OutcomeStatus
    reason: str
    estimate: Estimate | None = None

    @staticmethod
    def of(estimate: Estimate, judgement: Judgement | None = None) -> Outcome:
        """Return the outcome that an estimate is, after a judgement: another image may have to confirm it."""
        if judgement is not None and judgement.decision is Decision.AWAIT:
            return Outcome(OutcomeStatus.UNCONFIRMED, f"{judgement.note}: {estimate.reason}", estimate)
        return Outcome(OutcomeStatus(estimate.status.value), estimate.reason, estimate)

    @staticmethod
    def refused(reason: object) -> Outcome:
        """Return the outcome of an image that could not be tried: why, in words or as an exception that has them."""
        return Outcome(OutcomeStatus.REFUSED, shortened(str(reason)))

    @staticmethod
    def busy(reason: str) -> Outcome:
        """Return the outcome of a request that is not served; it starts with the word for those who read only that."""
        return Outcome(OutcomeStatus.BUSY, f"busy: {reason}")

    @staticmethod
    def error(exception: Exception) -> Outcome:
        """Return the outcome of an image on which an exception was met that nobody foresaw."""
        return Outcome(OutcomeStatus.ERROR, shortened(f"{type(exception).__name__}: {exception}"))

    @property
    def localized(self) -> bool:
        """Whether there is a pose to use."""
        return self.status is OutcomeStatus.LOCALIZED
