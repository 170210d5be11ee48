"""The ROS node: its life, its parameters, its time. What it does in between is in session.py."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable

from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from gsfeatloc_ros.common.threads import limit_threads
from gsfeatloc_ros.common.words import in_one_line, shortened
from gsfeatloc_ros.localize.engine import load_engine
from gsfeatloc_ros.node.diagnostics import Reporter
from gsfeatloc_ros.node.loading import load
from gsfeatloc_ros.node.map_change import MapChange
from gsfeatloc_ros.node.parameters import (
    PATH,
    check_choices,
    declare_parameters,
    prepare_change,
    read_settings,
    refuse_unreadable,
)
from gsfeatloc_ros.node.services import Services
from gsfeatloc_ros.node.session import Session
from gsfeatloc_ros.node.transforms import Transforms

# The clock may go back by less than this without a new run (of a bag, of a simulation) having begun.
_MAX_STEP_BACK = Duration(seconds=1)
# Seconds that the running localization gets to end when the node is cleaned up.
_STOP_TIMEOUT = 3.0
# Seconds without a sign of life from a localization that goes on; each of its steps takes less, on slow robots too.
_MAX_SILENCE = 120.0


_Transition = Callable[["LocalizerNode", LifecycleState], TransitionCallbackReturn]


def _logged(transition: _Transition) -> _Transition:
    """Log the exception of a transition, of which rclpy says nothing."""

    @functools.wraps(transition)
    def run(node: LocalizerNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except Exception as error:
            node.get_logger().fatal(in_one_line(error))
            return TransitionCallbackReturn.ERROR

    return run


class LocalizerNode(LifecycleNode):
    """A lifecycle node: configured, it has loaded the map; active, it listens, publishes and answers requests.

    It is for a GuardedExecutor: others cannot send what its services answer later.

    Args:
        go_on: is asked again and again while a map is loaded whether to go on waiting for it.

    Raises:
        ValueError, rclpy.exceptions.ParameterException: a parameter cannot be used; the message says why.
    """

    def __init__(self, go_on: Callable[[], bool] = lambda: True) -> None:
        super().__init__("localizer")
        self._go_on = go_on
        self._settings = declare_parameters(self)
        limit_threads(self._settings.cpu.threads)
        self._reporter = Reporter(self)
        # For good: tf2_ros's listener cannot be taken back.
        self._transforms = Transforms(self)
        self._session: Session | None = None
        self._map_change = MapChange(self, self._reporter)
        self._requests = Services(self, lambda: self._session, self.report_failure)
        # rclpy answers a transition that the state does not allow with an exception that ends the process.
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state
        refuse_unreadable(self)
        self.add_pre_set_parameters_callback(lambda parameters: prepare_change(self, parameters))
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._use_parameters)
        min_backward = Duration(nanoseconds=-_MAX_STEP_BACK.nanoseconds)
        threshold = JumpThreshold(min_forward=None, min_backward=min_backward, on_clock_change=False)
        self._jump_handle = self.get_clock().create_jump_callback(threshold, post_callback=self._on_time_jump)

    @property
    def autostart(self) -> bool:
        """Whether to configure and activate at once, without a lifecycle manager."""
        return self._settings.node.autostart

    def start(self) -> bool:
        """Configure and activate; return whether that worked, the log says why where it did not."""
        success = TransitionCallbackReturn.SUCCESS
        return self.trigger_configure() == success and self.trigger_activate() == success

    @property
    def finalized(self) -> bool:
        """Whether it was shut down by a transition: there is no way back."""
        return self._state_machine.current_state[0] == State.PRIMARY_STATE_FINALIZED

    @property
    def stuck(self) -> bool:
        """Whether a localization has begun that does not go on."""
        return self._session is not None and self._session.attempts.silent_seconds > _MAX_SILENCE

    @property
    def session(self) -> Session | None:
        """What there is while the node is configured."""
        return self._session

    @property
    def unanswered_requests(self) -> int:
        """Number of requests in progress."""
        return self._requests.unanswered

    def report_failure(self, error: Exception) -> None:
        """Log and publish that a callback failed, or that a message could not be taken; not too often."""
        try:
            self._reporter.fail(error)
        except Exception:  # of memory there may be none to say so
            sys.stderr.write("a callback failed, and the log fails as well\n")

    # The lifecycle.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the map, compile, be ready to listen; log why where that fails."""
        try:
            settings = load(self._settings.resolved, self._go_on)
            engine = load(
                lambda: load_engine(settings.map, settings.matcher, settings.renderer, settings.localizer), self._go_on
            )
            self._session = Session(self, settings, engine, self._transforms, self._reporter)
        except Exception as error:  # whatever it is: rclpy says nothing of it
            if self._go_on():
                self.get_logger().fatal(in_one_line(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen to topics and publish."""
        self._configured_session().activate()
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Neither listen nor publish."""
        self._configured_session().deactivate()
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of the map."""
        self._let_go()
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Do the same, from whatever state."""
        self._let_go()
        return TransitionCallbackReturn.SUCCESS

    @_logged
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of what is left after a transition that failed: it can be configured again."""
        self._let_go()
        return TransitionCallbackReturn.SUCCESS

    def _let_go(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            session.deactivate()
            session.stop(_STOP_TIMEOUT)
            session.close()

    def _configured_session(self) -> Session:
        assert self._session is not None  # the lifecycle sees to it
        return self._session

    def _on_change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        # rcl logs it.
        request.transition.label = shortened(request.transition.label)
        try:
            return self._change_state(request, response)
        except rclpy_implementation.RCLError as error:
            self._reporter.warn("transition", f"transition {request.transition.id} is not taken: {error}")
            response.success = False
            return response

    # Parameters.

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            check_choices(parameters)
            for parameter in parameters:
                if parameter.name == PATH:
                    self._map_change.check(parameter.value)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _use_parameters(self, parameters: list[Parameter]) -> None:
        self._settings = read_settings(self)
        if self._session is None:
            return
        self._session.use_settings(self._settings)
        if any(parameter.name == PATH for parameter in parameters):
            self._map_change.start(self._session, self._settings)

    # Time.

    def _on_time_jump(self, jump: TimeJump) -> None:
        now = self.get_clock().now().nanoseconds
        self.get_logger().warning(
            f"time went back by {-1e-9 * jump.delta.nanoseconds:.1f} s: what is stamped later is forgotten"
        )
        if self._session is not None:
            self._session.forget_after(now + _MAX_STEP_BACK.nanoseconds)
