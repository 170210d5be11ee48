"""One thread that works on what is requested and on the newest of what is offered, in turns."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from threading import Condition, Event, Thread
from typing import Generic, TypeVar

from gsfeatloc_ros.common.stage_clock import Interrupted

Item = TypeVar("Item")
Result = TypeVar("Result")

# Seconds since the last offer after which no more of them are waited for.
_OFFERS_END = 1.0


class UnservedError(Exception):
    """A request was not served, or not to its end: too many others wait, or its time is up, or nobody waits for it."""


@dataclass(frozen=True)
class QueueLimits:
    """How many requests may wait, for their turn or for the result that they share, and of how many bytes together.

    One may always wait, of whatever size.
    """

    requests: int = 8
    bytes: int = 32_000_000


@dataclass(frozen=True)
class Terms:
    """On what terms a request is made.

    Attributes:
        size: bytes that it holds while it waits.
        seconds: after which it is of no use any more.
        wanted: returns whether anybody waits for it still; asked when its turn has come.
    """

    size: int = 0
    seconds: float = math.inf
    wanted: Callable[[], bool] = lambda: True


NO_TERMS = Terms()


class _Task(Generic[Item, Result]):
    """A piece of work: offered, or asked for by so many `requests`; one that `yields` gives way to a request.

    At the time `asked` it asked last whether to go on.
    """

    def __init__(self, item: Item, terms: Terms = NO_TERMS) -> None:
        self.item, self.requests, self.yields = item, 0, False
        self.future: Future[Result] = Future()
        self.interrupted = Event()
        self.asked = time.monotonic()
        self.set_terms(terms)

    def set_terms(self, terms: Terms) -> None:
        self.terms, self.deadline = terms, time.monotonic() + terms.seconds

    @property
    def late(self) -> bool:
        return time.monotonic() > self.deadline

    def is_to_stop(self) -> bool:
        self.asked = time.monotonic()
        return self.interrupted.is_set() or self.late

    def drop(self, reason: str) -> None:
        self.future.set_exception(UnservedError(reason))

    def drop_late(self) -> None:
        self.drop(f"not served within {self.terms.seconds:g} s")


class Worker(Generic[Item, Result]):
    """Runs `work(item, interrupted)` in one thread.

    Items are offered, or requested. Of those offered only the newest waits. Requests wait in the order in which they
    come, within limits, and each is served by its deadline or ends in UnservedError. They go first: if one comes while
    an offered item is worked on, `interrupted()` turns true and `work` is to raise Interrupted. But where many come,
    both get the same time: after a request, the thread belongs for as long as that took to what is offered, which is
    then not interrupted. An exception of `work` goes to the Future; the thread lives on.

    Args:
        work: what to do with an item.
        same: whether two items are the same work, so that its result may be shared.

    Attributes:
        limits: of the queue; may be replaced later.
        unserved: number of requests that ended in UnservedError.
    """

    def __init__(
        self,
        work: Callable[[Item, Callable[[], bool]], Result],
        same: Callable[[Item, Item], bool] = lambda a, b: a is b,
    ) -> None:
        self.limits = QueueLimits()
        self.unserved = 0
        self._work, self._same = work, same
        self._changed = Condition()
        self._offered: _Task[Item, Result] | None = None
        self._requested: deque[_Task[Item, Result]] = deque()
        self._running: _Task[Item, Result] | None = None
        self._started = self._last_offer = self._offers_until = -math.inf
        self._stopping = False
        self._dropped = 0
        # A daemon: a call into native code that never returns must not keep the process alive.
        self._thread = Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Number of offered items that gave way to a newer one or to a request."""
        return self._dropped

    @property
    def waiting(self) -> int:
        """Number of requests that wait: for their turn, or for the result of what is done for another one."""
        with self._changed:
            sharing = max(0, self._running.requests - 1) if self._running else 0
            return sum(task.requests for task in self._requested) + sharing

    @property
    def silent_seconds(self) -> float:
        """For how long what it works on has not asked whether to go on; 0 for nothing."""
        with self._changed:
            return time.monotonic() - max(self._started, self._running.asked) if self._running else 0.0

    def offer(self, item: Item) -> None:
        """Work on `item` when it is its turn, unless a newer one is offered by then."""
        with self._changed:
            if not self._stopping:
                self._last_offer = time.monotonic()
                self._dropped += self._offered is not None
                self._offered = _Task(item)
                self._changed.notify()

    def request(self, item: Item, terms: Terms = NO_TERMS) -> Future[Result]:
        """Work on `item`; requests of the same one meanwhile share the result.

        The Future raises UnservedError where it is not served, and is cancelled when the worker stops before that.
        """
        new: _Task[Item, Result] = _Task(item, terms)
        with self._changed:
            if self._stopping:
                new.future.cancel()
                return new.future
            task = self._same_task(item)
            full = self._full(0 if task else terms.size)
            if full:
                self.unserved += 1
                new.drop(full)
                return new.future
            if task is None:
                task = new
                self._add(task)
            elif not task.requests:
                task.yields = False
                task.set_terms(terms)
            task.requests += 1
        return task.future

    def drop_late(self) -> None:
        """Tell those whose time is up while they wait; to be called now and then."""
        with self._changed:
            late = [task for task in self._requested if task.late]
            self._requested = deque(task for task in self._requested if not task.late)
            self.unserved += sum(task.requests for task in late)
        for task in late:
            task.drop_late()

    def stop(self, timeout: float) -> bool:
        """Cancel what waits, interrupt the running work, and return whether it ended within `timeout` seconds."""
        with self._changed:
            self._stopping = True
            waiting, self._requested, self._offered = self._requested, deque(), None
            if self._running:
                self._running.interrupted.set()
            self._changed.notify()
        for task in waiting:
            task.future.cancel()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _same_task(self, item: Item) -> _Task[Item, Result] | None:
        """Return the task whose result a request of `item` may share: what is worked on, or what is requested."""
        running = self._running
        if running and not running.interrupted.is_set() and self._same(running.item, item):
            return running
        return next((task for task in self._requested if self._same(task.item, item)), None)

    def _full(self, size: int) -> str:
        """Return why a request of so many bytes cannot wait; empty where it can."""
        held, waiting = sum(task.terms.size for task in self._requested), self.waiting
        if waiting >= self.limits.requests or (held and size and held + size > self.limits.bytes):
            return f"{waiting} requests of {1e-6 * held:.0f} MB wait"
        return ""

    def _add(self, task: _Task[Item, Result]) -> None:
        """Let a requested task wait for its turn."""
        if self._offered and self._same(self._offered.item, task.item):
            self._offered = None
        self._requested.append(task)
        if self._running and self._running.yields:
            self._running.interrupted.set()
        self._changed.notify()

    # In a thread of its own.

    def _run(self) -> None:
        task = self._next()
        while task is not None:
            if not task.terms.wanted():
                self._fail(task, UnservedError("whoever asked is gone"))
            elif task.late:
                self._fail(task, None)
            else:
                self._do(task)
            task = self._next()

    def _next(self) -> _Task[Item, Result] | None:
        """Wait for what is to be done next, and return it; None when there is nothing more to come."""
        with self._changed:
            if self._running and self._running.requests:
                now = time.monotonic()
                self._offers_until = now + (now - self._started)
            self._running = None
            while not self._stopping:
                now = time.monotonic()
                offers_end = min(self._offers_until, self._last_offer + _OFFERS_END)
                if self._requested and now >= offers_end:
                    self._running = self._requested.popleft()
                elif self._offered:
                    self._running, self._offered = self._offered, None
                    self._running.yields = now >= offers_end
                if self._running:
                    self._started = now
                    return self._running
                self._changed.wait(offers_end - now if self._requested else None)
        return None

    def _do(self, task: _Task[Item, Result]) -> None:
        try:
            result = self._work(task.item, task.is_to_stop)
        except Interrupted as error:
            self._dropped += not task.requests
            self._fail(task, error if task.interrupted.is_set() else None)
        except Exception as error:
            self._fail(task, error)
        else:
            task.future.set_result(result)

    def _fail(self, task: _Task[Item, Result], error: Exception | None) -> None:
        """End a task with an exception; without one it is late."""
        if error is None or isinstance(error, UnservedError):
            with self._changed:
                self.unserved += task.requests
        if error is None:
            task.drop_late()
        else:
            task.future.set_exception(error)
