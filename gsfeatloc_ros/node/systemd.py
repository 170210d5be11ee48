"""Tell systemd how the service does: the protocol of sd_notify(3), which is a datagram to a socket."""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Mapping

# Seconds that systemd may take to take what it is told, of which a few words wait in the socket; it asked for them.
_TIMEOUT = 0.5


class Systemd:
    """Tells systemd what it has asked to be told; does nothing where nobody asked.

    Where systemd cannot be told, which will have it end the service, that is said once on the standard error.

    Args:
        environment: NOTIFY_SOCKET and WATCHDOG_USEC are read.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # @ stands for the zero byte with which names begin that are in no folder.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        microseconds = environment.get("WATCHDOG_USEC", "")
        # Four beats in the time after which a silent service is killed.
        self._period = 1e-6 * int(microseconds) / 4 if microseconds.isdecimal() else None
        self._last_beat = 0.0
        self._heard = True

    def ready(self) -> None:
        """Say that the start is over; from now on it watches whether the heart beats."""
        self._tell("READY=1")

    def beat(self) -> None:
        """Say that all is well; may be called much more often than needed."""
        now = time.monotonic()
        if self._period is not None and now >= self._last_beat + self._period:
            self._last_beat = now
            self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """Say that the end has begun."""
        self._tell("STOPPING=1")

    def _tell(self, state: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stream:
                stream.settimeout(_TIMEOUT)
                stream.sendto(state.encode(), self._address)
            self._heard = True
        except OSError as error:
            if self._heard:
                said = f"systemd cannot be told {state}: NOTIFY_SOCKET is {self._address!r}: {error}"
                print(f"[WARN] [{time.time():.9f}] [localizer]: {said}", file=sys.stderr)
            self._heard = False
