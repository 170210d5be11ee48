"""The executable `localizer`: start, spin until it is to end, leave in order."""

from __future__ import annotations

import atexit
import sys
import time
from typing import TYPE_CHECKING

from gsfeatloc_ros.common.malloc import tune_malloc
from gsfeatloc_ros.common.threads import wait_passively
from gsfeatloc_ros.common.words import in_one_line
from gsfeatloc_ros.node.environment import check_environment
from gsfeatloc_ros.node.stop import Stop, leave
from gsfeatloc_ros.node.systemd import Systemd

if TYPE_CHECKING:
    from gsfeatloc_ros.node.executor import GuardedExecutor
    from gsfeatloc_ros.node.localizer_node import LocalizerNode

# Seconds that the running localization gets to end when the process is to, and requests in progress to be answered.
_STOP_TIMEOUT = 3.0
_ANSWER_TIMEOUT = 1.0
# Seconds between two looks whether to end while spinning.
_PERIOD = 0.1


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT, SIGTERM or a transition to `finalized`, and end the process with status 0.

    Where it cannot start, return 1; where it cannot go on, end the process with that. The last line says why.
    """
    # Before the imports below, which load OpenMP, and before the threads of the middleware.
    wait_passively()
    tune_malloc()
    stop, systemd = Stop(), Systemd()
    try:
        check_environment()
        # What these imports load takes seconds, and may not be there.
        import rclpy

        from gsfeatloc_ros.node.executor import GuardedExecutor, HopelessError
        from gsfeatloc_ros.node.localizer_node import LocalizerNode
        from gsfeatloc_ros.node.parameters import with_lists_of_doubles

        # rclpy's own handlers shut the context down at once; the running localization and requests are to end first.
        rclpy.init(
            args=with_lists_of_doubles(args or sys.argv), signal_handler_options=rclpy.signals.SignalHandlerOptions.NO
        )
        stop.in_order = True

        def go_on() -> bool:
            systemd.beat()
            return not stop

        node = LocalizerNode(go_on)
    except Exception as error:
        # There is no node whose log could say it.
        print(f"[FATAL] [{time.time():.9f}] [localizer]: {in_one_line(error)}", file=sys.stderr)
        return 1
    if node.autostart and not node.start():
        # The reason is in the log. What was given up may still be at work.
        leave(0 if stop else 1)
    systemd.ready()
    executor = GuardedExecutor(node.report_failure)
    executor.add_node(node)
    try:
        while not stop:
            executor.spin_once(_PERIOD)
            if not node.stuck:
                systemd.beat()
            if node.finalized:
                stop.ask()
    except HopelessError as error:
        node.get_logger().fatal(in_one_line(error))
        leave(1)
    systemd.stopping()
    _end(node, executor)
    # The interpreter's own end takes back what was compiled in this run, for seconds, and pulls what still loads away.
    atexit._run_exitfuncs()
    leave(0)


def _end(node: LocalizerNode, executor: GuardedExecutor) -> None:
    """Give up what runs, answer who waits, and leave the graph."""
    import rclpy

    session = node.session
    if session and not session.stop(_STOP_TIMEOUT):
        node.get_logger().warning("the running localization did not end in time")
        leave(0)
    # A service cannot wait for acknowledgements: the answers get this long to be sent and to arrive.
    deadline = time.monotonic() + (_ANSWER_TIMEOUT if node.unanswered_requests or node.finalized else 0.0)
    while time.monotonic() < deadline:
        executor.spin_once(_PERIOD)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    sys.exit(main())
