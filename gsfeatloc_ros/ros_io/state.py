"""Where the robot stands: localized, coasting, or lost; and which answers it may go on from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from threading import Lock

import numpy as np

from gsfeatloc_ros.common.geometry import rotation_error_deg, translation_error
from gsfeatloc_ros.common.parameter import parameter
from gsfeatloc_ros.ros_io.growth import position_sigma, rotation_sigma
from gsfeatloc_ros.ros_io.prior import PriorSource

# An answer confirms another that is carried to it within this many standard deviations.
_MAX_AGREEING = 1.0
# An answer farther than this many from where the last one was carried is a jump.
_MAX_STEADY = 3.0
# Nothing is known better than this, in map units or radians.
_MIN_SIGMA = 1e-9


class State(Enum):
    """What is known of the robot's pose. The value is what people read."""

    LOCALIZED = "localized"
    COASTING = "coasting"
    LOST = "lost"


class Decision(Enum):
    """What is to be done after an attempt."""

    PUBLISH = "publish the answer and go on from it"
    AWAIT = "go on from the answer, and publish it once another one agrees"
    CARRY_ON = "go on as before"
    FORGET = "forget what the attempt started from"


@dataclass(frozen=True)
class StateOptions:
    """When a robot counts as coasting and as lost, and what it takes to be found again."""

    confirm: int = parameter(
        1,
        "More images that must agree with an answer found without a prior, or far from the last, before it is "
        "published; only where odometry carries it to them.",
        (0, 10),
        live=True,
    )
    coast_after: float = parameter(
        2.0, "Seconds without an answer after which the state is COASTING.", (0.0, 1e6), live=True
    )
    lost_after: float = parameter(
        15.0, "Seconds of images without an answer after which the state is LOST.", (0.0, 1e6), live=True
    )
    lost_distance: float = parameter(
        5.0,
        "Standard deviation of the carried position, in map units, above which the state is LOST.",
        (0.0, 1e6),
        live=True,
    )


@dataclass(frozen=True, eq=False)
class Attempt:
    """An image that was tried.

    Attributes:
        source: of the prior; None where there was none.
        T_map_camera_prior: (4, 4) that it started from; None for none.
        prior_covariance: (6, 6) of it; None where it is not known.
        T_map_camera: (4, 4) the answer; None for none.
        confirmable: whether odometry will carry the answer to another image, which may confirm it.
    """

    source: PriorSource | None
    T_map_camera_prior: np.ndarray | None = None
    prior_covariance: np.ndarray | None = None
    T_map_camera: np.ndarray | None = None
    confirmable: bool = False


@dataclass(frozen=True)
class Judgement:
    """What is to be done after an attempt, and what there is to say about it."""

    decision: Decision
    note: str = ""


@dataclass(frozen=True)
class Standing:
    """The state, why it was entered, for how many seconds it has lasted, and how many attempts failed meanwhile."""

    state: State
    reason: str
    seconds: float
    failures: int


class LocalizationState:
    """Keeps the state; from any thread.

    Time passes on the node's clock, whatever stamps images have: a bag may be of last year.

    Args:
        options: may be replaced later.
        now: nanoseconds.
    """

    def __init__(self, options: StateOptions, now: Callable[[], int]) -> None:
        self.options = options
        self._now = now
        self._lock = Lock()
        self._state, self._reason = State.LOST, "nothing was localized yet"
        self._since = self._answered = now()
        self._agreed = self._failures = self._resets = 0

    @property
    def resets(self) -> int:
        """How often all was forgotten: what began before that does not count any more."""
        return self._resets

    @property
    def failures(self) -> int:
        """Number of attempts since the last answer."""
        return self._failures

    def standing(self) -> Standing:
        """Return how things stand now."""
        with self._lock:
            return Standing(self._state, self._reason, self._seconds_since(self._since), self._failures)

    def reset(self, reason: str) -> None:
        """Be lost, for this reason."""
        with self._lock:
            self._resets += 1
            self._agreed = self._failures = 0
            self._enter(State.LOST, reason)

    def outgrown(self, source: PriorSource | None, covariance: np.ndarray | None) -> bool:
        """Return whether an own answer, carried up to now, is worth nothing any more; then the robot is lost.

        Args:
            source: of the prior that it has become.
            covariance: (6, 6) of it.
        """
        if source not in (PriorSource.LAST_ANSWER, PriorSource.UNCONFIRMED) or covariance is None:
            return False
        return self._outgrown(position_sigma(covariance))

    def pass_time(self, sigma: float | None, images_wanted: bool) -> None:
        """Note that time has passed, perhaps without images.

        Args:
            sigma: of the position as odometry has carried it, in map units; None where there is no odometry.
            images_wanted: whether images ought to have come.
        """
        if sigma is not None and self._outgrown(sigma):
            return
        with self._lock:
            if sigma is None and images_wanted:
                self._age()
            elif self._state is State.LOCALIZED and self._unanswered > self.options.coast_after:
                self._enter(State.COASTING, "no answer of late")

    def take(self, attempt: Attempt) -> Judgement:
        """Take what came of an image, and return what is to be done."""
        with self._lock:
            if attempt.T_map_camera is None:
                return self._fail(attempt)
            self._failures = 0
            jump = self._jump(attempt)
            if self._is_to_be_confirmed(attempt, bool(jump)):
                return Judgement(Decision.AWAIT, f"{jump or 'found without a prior'}: the next image has to agree")
            note = jump
            if self._state is State.LOST:
                note = note or f"found again after {self._seconds_since(self._since):.1f} s"
            self._answered, self._agreed = self._now(), 0
            self._enter(State.LOCALIZED, note or "answered")
            return Judgement(Decision.PUBLISH, note)

    def _fail(self, attempt: Attempt) -> Judgement:
        self._failures += 1
        lost = self._age() is State.LOST
        if attempt.source is PriorSource.UNCONFIRMED:
            return Judgement(Decision.FORGET, "the answer before was not confirmed")
        worthless = lost and self._unanswered > self.options.lost_after
        return Judgement(Decision.FORGET if worthless else Decision.CARRY_ON)

    def _age(self) -> State:
        """Go on to the state that so many seconds without an answer lead to, and return it."""
        if self._state is not State.LOST:
            if self._unanswered > self.options.lost_after:
                self._enter(State.LOST, f"no answer for {self._unanswered:.1f} s")
            elif self._unanswered > self.options.coast_after:
                self._enter(State.COASTING, "no answer of late")
        return self._state

    def _outgrown(self, sigma: float) -> bool:
        with self._lock:
            if sigma <= self.options.lost_distance:
                return False
            if self._state is not State.LOST:
                self._enter(State.LOST, f"the position is uncertain by {sigma:.1f} (search.lost_distance)")
            return True

    def _is_to_be_confirmed(self, attempt: Attempt, jumps: bool) -> bool:
        if attempt.source is PriorSource.UNCONFIRMED:
            self._agreed = self._agreed + 1 if _apart(attempt) <= _MAX_AGREEING else 0
        elif is_unattested(attempt.source) or jumps:
            self._agreed = 0
        else:
            return False
        return attempt.confirmable and self._agreed < self.options.confirm

    def _jump(self, attempt: Attempt) -> str:
        """Return in words how the answer jumps away from where the last one was carried; empty where it does not."""
        if attempt.source is not PriorSource.LAST_ANSWER or _apart(attempt) <= _MAX_STEADY:
            return ""
        assert attempt.T_map_camera_prior is not None  # otherwise nothing is apart
        assert attempt.T_map_camera is not None
        distance = translation_error(attempt.T_map_camera_prior, attempt.T_map_camera)
        angle = rotation_error_deg(attempt.T_map_camera_prior, attempt.T_map_camera)
        return f"the pose jumps by {distance:.2f} and {angle:.0f} degrees"

    def _enter(self, state: State, reason: str) -> None:
        if state is not self._state:
            self._state, self._reason, self._since = state, reason, self._now()
        elif state is State.LOST:
            self._reason = reason

    @property
    def _unanswered(self) -> float:
        return self._seconds_since(self._answered)

    def _seconds_since(self, moment: int) -> float:
        # Time may go back.
        return max(0.0, 1e-9 * (self._now() - moment))


def is_unattested(source: PriorSource | None) -> bool:
    """Return whether an answer that was found from such a prior, or from none, has nobody's word but its own."""
    return source in (None, PriorSource.SAVED, PriorSource.PLANE)


def _apart(attempt: Attempt) -> float:
    """Return how far the answer is from the prior, in the standard deviations of position and of rotation."""
    prior, covariance, pose = attempt.T_map_camera_prior, attempt.prior_covariance, attempt.T_map_camera
    if prior is None or covariance is None or pose is None:
        return 0.0
    errors = translation_error(prior, pose), np.radians(rotation_error_deg(prior, pose))
    sigmas = position_sigma(covariance), rotation_sigma(covariance)
    return float(max(error / max(sigma, _MIN_SIGMA) for error, sigma in zip(errors, sigmas, strict=True)))
