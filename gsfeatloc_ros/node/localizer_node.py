"""The ROS node: its life, its parameters, its time. What it does in between is in session.py."""

from __future__ import annotations

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from gsfeatloc_ros.common.threads import limit_threads
from gsfeatloc_ros.localize.engine import load_engine
from gsfeatloc_ros.node.diagnostics import Reporter
from gsfeatloc_ros.node.map_change import PATH, MapChange
from gsfeatloc_ros.node.parameters import check_choices, declare_parameters, prepare_change, read_settings
from gsfeatloc_ros.node.services import Services
from gsfeatloc_ros.node.session import Session
from gsfeatloc_ros.node.transforms import Transforms

# The clock may go back by less than this without a new run (of a bag, of a simulation) having begun.
_MAX_STEP_BACK = Duration(seconds=1)
# Seconds that the running localization gets to end when the node is cleaned up.
_STOP_TIMEOUT = 3.0


class LocalizerNode(LifecycleNode):
    """A lifecycle node: configured, it has loaded the map; active, it listens, publishes and answers requests.

    Raises:
        ValueError, rclpy.exceptions.ParameterException: a parameter cannot be used; the message says why.
    """

    def __init__(self) -> None:
        super().__init__("localizer")
        self._settings = declare_parameters(self)
        limit_threads(self._settings.cpu.threads)
        self._reporter = Reporter(self)
        # For good: tf2_ros's listener cannot be taken back.
        self._transforms = Transforms(self)
        self._session: Session | None = None
        self._map_change = MapChange(self, self._reporter)
        self._requests = Services(self, lambda: self._session)
        # rclpy answers a transition that the state does not allow with an exception that ends the process.
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state
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

    @property
    def session(self) -> Session | None:
        """What there is while the node is configured."""
        return self._session

    @property
    def unanswered_requests(self) -> int:
        """Number of requests in progress."""
        return self._requests.unanswered

    # The lifecycle.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the map, compile, be ready to listen; log why where that fails."""
        settings = self._settings
        try:
            engine = load_engine(settings.map, settings.matcher, settings.renderer, settings.localizer)
            self._session = Session(self, settings, engine, self._transforms, self._reporter)
        except (ValueError, OSError, RuntimeError) as error:
            self.get_logger().fatal(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen to topics and publish."""
        self._configured_session().activate()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Neither listen nor publish."""
        self._configured_session().deactivate()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of the map."""
        session = self._configured_session()
        session.stop(_STOP_TIMEOUT)
        session.close()
        self._session = None
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Do the same, from whatever state."""
        if self._session is None:
            return TransitionCallbackReturn.SUCCESS
        self._session.deactivate()
        return self.on_cleanup(state)

    def _configured_session(self) -> Session:
        assert self._session is not None  # the lifecycle sees to it
        return self._session

    def _on_change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        try:
            return self._change_state(request, response)
        except rclpy_implementation.RCLError as error:
            self.get_logger().warning(f"transition {request.transition.id} is not taken: {error}")
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
