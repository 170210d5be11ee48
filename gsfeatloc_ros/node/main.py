"""The executable `localizer`: start, spin until a signal, leave in order."""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType

from gsfeatloc_ros.common.threads import wait_passively

# Seconds that the running localization gets to end after a signal, and requests in progress to be answered.
_STOP_TIMEOUT = 3.0
_ANSWER_TIMEOUT = 0.5
# Seconds after which a process that still has not left is ended.
_LEAVE_TIMEOUT = 10.0
# Seconds between two looks for a signal while spinning.
_SIGNAL_PERIOD = 0.1


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit status."""
    # Before the imports below: they load OpenMP, and take seconds, in which a signal must not end in a traceback.
    wait_passively()
    _on_signal(lambda number, frame: sys.exit(0))
    import rclpy
    from rclpy.exceptions import ParameterException
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.lifecycle import TransitionCallbackReturn
    from rclpy.signals import SignalHandlerOptions

    from gsfeatloc_ros.node.localizer_node import LocalizerNode
    from gsfeatloc_ros.node.parameters import with_lists_of_doubles

    # rclpy's own handlers shut the context down at once; the running localization and requests are to end first.
    try:
        rclpy.init(args=with_lists_of_doubles(args or sys.argv), signal_handler_options=SignalHandlerOptions.NO)
        node = LocalizerNode()
    except (ValueError, ParameterException) as error:
        rclpy.logging.get_logger("localizer").fatal(str(error))
        return 1
    if node.autostart:
        if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
            return 1  # the reason is in the log
        node.trigger_activate()
    stopping = threading.Event()
    _on_signal(lambda number, frame: stopping.set())
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stopping.is_set():
        executor.spin_once(timeout_sec=_SIGNAL_PERIOD)

    # Should anything below hang, in the middleware say, the process ends all the same, and the log shows where it was.
    faulthandler.dump_traceback_later(_LEAVE_TIMEOUT, exit=True)
    session = node.session
    if session and not session.stop(_STOP_TIMEOUT):
        node.get_logger().warning("the running localization did not end in time")
        # The thread is in native code that the interpreter's own exit would pull away under it.
        sys.stderr.flush()
        os._exit(0)
    if node.unanswered_requests:
        # A service cannot wait for acknowledgements: the answers get this long to be sent and to arrive.
        deadline = time.monotonic() + _ANSWER_TIMEOUT
        while time.monotonic() < deadline:
            executor.spin_once(timeout_sec=_SIGNAL_PERIOD)
    node.destroy_node()
    rclpy.shutdown()
    return 0


def _on_signal(handler: Callable[[int, FrameType | None], None]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


if __name__ == "__main__":
    sys.exit(main())
