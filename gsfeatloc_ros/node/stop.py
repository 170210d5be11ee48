"""The end of the process: asked for by a signal, and sure to come."""

from __future__ import annotations

import faulthandler
import os
import signal
import socket
import sys
import threading
from contextlib import suppress
from types import FrameType
from typing import NoReturn

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# Seconds after which a process that was to end and still has not is ended by force.
_TIMEOUT = 4.5


class Stop:
    """Whether the process is to end, by SIGINT or SIGTERM or because `ask` was called.

    It then ends within 4.5 seconds whatever hangs, in the middleware or in native code say, and prints where it was.

    Attributes:
        in_order: whether it is the main thread that ends it; until then a signal ends it at once, for there is nothing
            to be tidied up, and an exception in the middle of an import may be lost.
    """

    def __init__(self) -> None:
        self.in_order = False
        self._asked = threading.Event()
        # Python's own handlers wait for the main thread, which may be in native code: C writes to this at once.
        self._woken, self._wake = socket.socketpair()
        self._wake.setblocking(False)
        signal.set_wakeup_fd(self._wake.fileno())
        threading.Thread(target=self._watch, name="stop", daemon=True).start()
        for number in _SIGNALS:
            signal.signal(number, self._on_signal)

    def __bool__(self) -> bool:
        return self._asked.is_set()

    def ask(self) -> None:
        """Have the process end."""
        self._asked.set()
        self._wake.send(b"\0")

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if not self.in_order:
            leave(0)
        self._asked.set()

    def _watch(self) -> None:
        self._woken.recv(1)
        # In a thread of C's, which does not wait for Python.
        faulthandler.dump_traceback_later(_TIMEOUT, exit=True)


def leave(status: int) -> NoReturn:
    """End the process at once: threads may be in native code that the interpreter's own exit would pull away."""
    for stream in (sys.stdout, sys.stderr):
        # What a signal interrupted in the middle of writing, or nobody reads any more, is lost.
        with suppress(RuntimeError, OSError):
            stream.flush()
    os._exit(status)
