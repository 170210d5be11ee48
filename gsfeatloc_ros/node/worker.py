"""One thread that works on what is requested, and in between on the newest of what is offered."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from threading import Condition, Event, Thread
from typing import Generic, TypeVar

from gsfeatloc_ros.common.stage_clock import Interrupted

Item = TypeVar("Item")
Result = TypeVar("Result")


class _Task(Generic[Item, Result]):
    def __init__(self, item: Item) -> None:
        self.item = item
        self.future: Future[Result] = Future()
        self.interrupted = Event()


class Worker(Generic[Item, Result]):
    """Runs `work(item, interrupted)` in one thread.

    Items are offered, or requested. Of those offered only the newest waits, and it gives way to requests: if one comes
    while an offered item is worked on, `interrupted()` turns true and `work` is to raise Interrupted. Requests are all
    served, in the order in which they came. An exception of `work` goes to the Future; the thread lives on.
    """

    def __init__(self, work: Callable[[Item, Callable[[], bool]], Result]) -> None:
        self._work = work
        self._changed = Condition()
        self._offered: _Task[Item, Result] | None = None
        self._requested: deque[_Task[Item, Result]] = deque()
        self._running: _Task[Item, Result] | None = None
        self._running_was_requested = False
        self._stopping = False
        self._dropped = 0
        # A daemon: a call into native code that never returns must not keep the process alive.
        self._thread = Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Number of offered items that gave way to a newer one or to a request."""
        return self._dropped

    def offer(self, item: Item) -> None:
        """Work on `item` when nothing is requested, unless a newer one is offered by then."""
        with self._changed:
            if not self._stopping:
                self._dropped += self._offered is not None
                self._offered = _Task(item)
                self._changed.notify()

    def request(self, item: Item) -> Future[Result]:
        """Work on `item` in any case; requests of the same one meanwhile share the result.

        The Future is cancelled when the worker stops before that.
        """
        with self._changed:
            running = self._running
            if running and running.item is item and not running.interrupted.is_set():
                self._running_was_requested = True
                return running.future
            for waiting in self._requested:
                if waiting.item is item:
                    return waiting.future
            if self._offered and self._offered.item is item:
                self._offered = None
            task: _Task[Item, Result] = _Task(item)
            if self._stopping:
                task.future.cancel()
                return task.future
            self._requested.append(task)
            if running and not self._running_was_requested:
                running.interrupted.set()
            self._changed.notify()
        return task.future

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

    def _run(self) -> None:
        while True:
            with self._changed:
                self._running = None
                self._changed.wait_for(lambda: self._requested or self._offered or self._stopping)
                if self._stopping:
                    return
                self._running_was_requested = bool(self._requested)
                task = self._requested.popleft() if self._requested else self._offered
                assert task is not None  # that was waited for
                if not self._running_was_requested:
                    self._offered = None
                self._running = task
            try:
                result = self._work(task.item, task.interrupted.is_set)
            except Interrupted as error:
                self._dropped += 1
                task.future.set_exception(error)
            except Exception as error:
                task.future.set_exception(error)
            else:
                task.future.set_result(result)
