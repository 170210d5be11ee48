"""Where the time of a localization, or of a frame, goes, and when it is over."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Interrupted(Exception):  # noqa: N818 - it is no error
    """The work was given up on request."""


class OutOfTime(Exception):  # noqa: N818 - nor is this
    """The work has taken as long as it may."""


class StageClock:
    """Adds up the time of named stages.

    Args:
        now: returns the time in seconds: wall time, or e.g. time.process_time. For the stages of a GPU it waits for it.
        interrupted: returns whether to give up; asked before each stage, which then raises Interrupted.
        deadline: seconds after which a stage that is to begin, but for the first, raises OutOfTime.
    """

    def __init__(
        self,
        now: Callable[[], float] = time.perf_counter,
        interrupted: Callable[[], bool] = lambda: False,
        deadline: float = math.inf,
    ) -> None:
        self._now = now
        self._interrupted = interrupted
        self._deadline = deadline
        self._start = now()
        self._stages: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time inside the block as that of the stage `name`."""
        if self._interrupted():
            raise Interrupted
        start = self._now()
        if self._stages and start - self._start > self._deadline:
            raise OutOfTime
        yield
        self._stages[name] = self._stages.get(name, 0.0) + self._now() - start

    def milliseconds(self) -> dict[str, float]:
        """Return the milliseconds by stage, and "total" since the clock was made."""
        total = self._now() - self._start
        return {name: 1e3 * seconds for name, seconds in (self._stages | {"total": total}).items()}
