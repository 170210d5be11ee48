"""One thread that works on the newest item only."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from threading import Condition, Thread
from typing import Generic, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class LatestWorker(Generic[Item, Result]):
    """Runs `work(item)` in one thread; an item still waiting gives way to a newer one.

    Whoever submitted an item that gave way gets the result for the newer one: a Future promises the result for the
    newest item known when the work starts. An exception of `work` goes to the Future; the thread lives on.
    """

    def __init__(self, work: Callable[[Item], Result]) -> None:
        self._work = work
        self._changed = Condition()
        self._waiting: tuple[Item, Future[Result]] | None = None
        self._stopping = False
        self._dropped = 0
        # A daemon: a call into native code that never returns must not keep the process alive.
        self._thread = Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Number of items that gave way to a newer one before they were worked on."""
        return self._dropped

    def submit(self, item: Item) -> Future[Result]:
        """Work on `item` next; the Future is cancelled when the worker stops before that."""
        with self._changed:
            waiting_item, future = self._waiting or (item, Future())
            if waiting_item is not item:
                self._dropped += 1
            if not self._stopping:
                self._waiting = (item, future)
                self._changed.notify()
        if self._stopping:
            future.cancel()
        return future

    def stop(self, timeout: float) -> bool:
        """Cancel what waits, let the running work end for up to `timeout` seconds, and say whether it ended."""
        with self._changed:
            self._stopping = True
            waiting, self._waiting = self._waiting, None
            self._changed.notify()
        if waiting:
            waiting[1].cancel()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopping)
                if self._waiting is None:
                    return
                (item, future), self._waiting = self._waiting, None
            if not future.set_running_or_notify_cancel():
                continue
            try:
                result = self._work(item)
            except Exception as error:
                future.set_exception(error)
            else:
                future.set_result(result)
