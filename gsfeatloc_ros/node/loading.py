"""What takes long, in a thread of its own, so that who waits for it can be told to stop and does not wait for ever."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TypeVar

Result = TypeVar("Result")

# Seconds that a map may take. The first start on a machine compiles, with a GPU for minutes; a pipe, or a file system
# that is gone, takes for ever.
LOAD_TIMEOUT = 900.0
# Seconds between two looks whether to go on.
_PERIOD = 0.1


class GivenUpError(RuntimeError):
    """What was waited for takes too long, or is not wanted any more; its thread may go on."""


def load(work: Callable[[], Result], go_on: Callable[[], bool], timeout: float = LOAD_TIMEOUT) -> Result:
    """Return the result of `work()`, or raise its exception.

    Args:
        work: is done in a thread of its own.
        go_on: is asked ten times a second whether to go on waiting.
        timeout: seconds to wait.

    Raises:
        GivenUpError: it took longer, or was not to go on.
    """
    done: Future[Result] = Future()

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as error:
            done.set_exception(error)

    # A daemon: what hangs must not keep the process alive.
    threading.Thread(target=run, name="loader", daemon=True).start()
    deadline = time.monotonic() + timeout
    while not wait([done], _PERIOD).done:
        if not go_on():
            raise GivenUpError("given up before it was loaded")
        if time.monotonic() > deadline:
            raise GivenUpError(f"loading took longer than {timeout:g} s: does its disk, or a pipe, hang?")
    return done.result()
