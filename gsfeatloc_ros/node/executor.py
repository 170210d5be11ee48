"""The executor's loop, which no single message ends."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor, await_or_execute
from rclpy.impl.implementation_singleton import rclpy_implementation

# So many failures in a row, over so many seconds without one callback that ended well, and nothing is to be hoped for.
_MAX_FAILURES = 10
_MAX_SECONDS = 10.0
# Requests that are taken from a service before all else is looked at again.
_MAX_REQUESTS = 64
# Seconds of rest after a failure of the loop itself: what is missing, memory say, may be there again.
_REST = 0.1


class HopelessError(RuntimeError):
    """All that the executor does fails, again and again."""


@dataclass(frozen=True)
class Later:
    """What the callback of a service returns in place of a response that is not there yet.

    rclpy would have it be a coroutine, and runs each that waits a bit further whenever anything at all comes.

    Attributes:
        done: when this is, the response can be made.
        make: makes it, in the executor's thread.
    """

    done: Future[Any]
    make: Callable[[], Any]


class GuardedExecutor(SingleThreadedExecutor):
    """Goes on where a callback raises an exception, or a message cannot be taken.

    rclpy lets such an exception end the process. One of the taking (no memory for a big request) leaves the topic or
    service, and all others of its callback group, blocked for good besides.

    Of a service all requests that wait are taken together. rclpy takes one, and then makes a new wait set of all that
    the node has, which takes more time than most requests do: of many that come at once the last would wait for long.

    Args:
        on_failure: is told each exception.
        now: seconds on a clock that runs evenly.
        **arguments: of rclpy's executor.
    """

    def __init__(
        self, on_failure: Callable[[Exception], None], now: Callable[[], float] = time.monotonic, **arguments: Any
    ) -> None:
        super().__init__(**arguments)
        self._on_failure, self._now = on_failure, now
        self._failures, self._failing_since = 0, 0.0

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Take and execute what is ready.

        Raises:
            HopelessError: nothing has succeeded for long; the message names the last failure.
        """
        try:
            super().spin_once(timeout_sec)
        except ExternalShutdownException:
            raise
        except Exception as error:
            self._fail(error)
            time.sleep(_REST)
        if self._failures >= _MAX_FAILURES and self._now() - self._failing_since > _MAX_SECONDS:
            raise HopelessError(f"{self._failures} failures in a row and no success: {self._last_failure}")

    def _make_handler(self, entity: Any, node: Any, take_from_wait_list: Callable[[Any], Any]) -> Any:
        """Make rclpy's handler, of parts that do not raise: then it leaves everything in order."""

        def take(entity: Any) -> Any:
            try:
                execute = take_from_wait_list(entity)
            except Exception as error:
                self._fail(error)
                return None
            return None if execute is None else self._guarded(execute)

        return super()._make_handler(entity, node, take)

    def _take_service(self, service: Any) -> Callable[[], Any] | None:
        """Take the requests that wait, and return a coroutine function that has them answered one after another."""
        requests: list[Any] = []
        try:
            with service.handle:
                while len(requests) < _MAX_REQUESTS and (taken := self._take_request(service))[1] is not None:
                    requests.append(taken)
        except rclpy_implementation.InvalidHandle:
            return None
        except Exception as error:
            self._fail(error)

        async def send(make: Callable[[], Any], header: Any) -> None:
            service.send_response(make(), header)

        async def answer(request: Any, header: Any) -> None:
            response = await await_or_execute(service.callback, request, service.srv_type.Response())
            if not isinstance(response, Later):
                service.send_response(response, header)
            elif response.done.done():
                await send(response.make, header)
            else:
                task = self._guarded(partial(send, response.make, header))
                response.done.add_done_callback(lambda _: self.create_task(task))

        async def answer_all() -> None:
            for taken in requests:
                # Begun here, in the order in which they came: the executor takes the newest task first.
                self.create_task(self._guarded(partial(answer, *taken)))()

        return answer_all if requests else None

    def _take_request(self, service: Any) -> tuple[Any, Any]:
        """Return a request and whose it is; None and None where none waits."""
        taken: tuple[Any, Any] = service.handle.service_take_request(service.srv_type.Request)
        return taken

    def _guarded(self, execute: Callable[[], Any]) -> Callable[[], Any]:
        """Return a coroutine function that does not raise."""

        async def run() -> None:
            try:
                await execute()
            except Exception as error:
                self._fail(error)
            else:
                self._failures = 0

        return run

    def _fail(self, error: Exception) -> None:
        if not self._failures:
            self._failing_since = self._now()
        self._failures += 1
        self._last_failure = f"{type(error).__name__}: {error}"
        self._on_failure(error)
