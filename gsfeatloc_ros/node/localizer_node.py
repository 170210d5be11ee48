"""The ROS node: its life, its parameters, the change of its map. What it does in between is in session.py."""

from __future__ import annotations

import os
import threading
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from gsfeatloc_ros.localize.engine import Engine, load_engine
from gsfeatloc_ros.node.diagnostics import ERROR, OK, Reporter
from gsfeatloc_ros.node.parameters import check_choices, declare_parameters
from gsfeatloc_ros.node.session import LocalizeImage, Session
from gsfeatloc_ros.node.transforms import Transforms

# The clock may go back by less than this without a new run (of a bag, of a simulation) having begun.
_BACKWARDS = Duration(seconds=-1)
# Seconds that the running localization gets to end when the node is cleaned up.
_STOP_TIMEOUT = 3.0
_UNCONFIGURED = "the node is not configured: configure and activate it (ros2 lifecycle set ... configure)"


class LocalizerNode(LifecycleNode):
    """A lifecycle node: configured, it has loaded the map and answers requests; active, it listens and publishes.

    Raises:
        ValueError, rclpy.exceptions.ParameterException: a parameter cannot be used; the message says why.
    """

    def __init__(self) -> None:
        super().__init__("localizer")
        self._values = declare_parameters(self)
        self._reporter = Reporter(self)
        # For good: tf2_ros's listener cannot be taken back.
        self._transforms = Transforms(self)
        self._session: Session | None = None
        # Path of the map that is being loaded while another serves.
        self._loading = ""
        # Whether map.path is set to that of the old map because the new one could not be loaded.
        self._going_back = False
        # They outlive the session, whose last answers would find no service to be sent by. Reentrant: a request that
        # waits for the worker must not hold up the next one.
        group = ReentrantCallbackGroup()
        self.create_service(Trigger, "~/relocalize", self._on_relocalize, callback_group=group)
        if LocalizeImage is None:
            self.get_logger().info(
                "the service ~/localize_image is off: build the package gsfeatloc_interfaces (interfaces/), source it"
            )
        else:
            self.create_service(LocalizeImage, "~/localize_image", self._on_localize_image, callback_group=group)
        # rclpy answers a transition that the state does not allow with an exception that ends the process.
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._use_parameters)
        threshold = JumpThreshold(min_forward=None, min_backward=_BACKWARDS, on_clock_change=False)
        self._jump_handle = self.get_clock().create_jump_callback(threshold, post_callback=self._on_time_jump)

    @property
    def autostart(self) -> bool:
        """Whether to configure and activate without being told to."""
        return self._values["autostart"]

    @property
    def session(self) -> Session | None:
        """What runs while the node is configured."""
        return self._session

    # The lifecycle.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the map, compile, be ready for requests; a failure is logged with its reason."""
        try:
            engine = load_engine(self._values)
            self._session = Session(self, self._values, engine, self._transforms, self._reporter)
        except (ValueError, OSError, RuntimeError) as error:
            self.get_logger().fatal(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen to topics and publish."""
        self._session.activate()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Neither listen nor publish."""
        self._session.deactivate()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of the map."""
        self._session.stop(_STOP_TIMEOUT)
        self._session.close()
        self._session = None
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The same, from whatever state."""
        if self._session is None:
            return TransitionCallbackReturn.SUCCESS
        self._session.deactivate()
        return self.on_cleanup(state)

    def _on_change_state(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        try:
            return self._change_state(request, response)
        except rclpy_implementation.RCLError as error:
            self.get_logger().warning(f"transition {request.transition.id} is not taken: {error}")
            response.success = False
            return response

    # Requests.

    async def _on_relocalize(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._session is None:
            response.success, response.message = False, _UNCONFIGURED
            return response
        return await self._session.on_relocalize(request, response)

    async def _on_localize_image(self, request: Any, response: Any) -> Any:
        if self._session is None:
            response.status, response.reason = response.REFUSED, _UNCONFIGURED
            return response
        return await self._session.on_localize_image(request, response)

    # Parameters.

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        new = {parameter.name: parameter.value for parameter in parameters}
        try:
            check_choices(new)
            if "map.path" in new and not self._going_back:
                if self._loading:
                    raise ValueError(f"map {self._loading} is being loaded: wait for it")
                if not os.path.exists(new["map.path"]):
                    raise ValueError(f"map.path: there is no {new['map.path']!r}")
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _use_parameters(self, parameters: list[Parameter]) -> None:
        new = {parameter.name: parameter.value for parameter in parameters if parameter.name in self._values}
        self._values = self._values | new
        if self._session is None:
            return
        self._session.use_parameters(self._values)
        # Set to the same path again, the file is read again.
        if "map.path" in new and not self._going_back:
            self._loading = new["map.path"]
            # The old map serves meanwhile.
            threading.Thread(target=self._load, args=(self._session, self._values), name="loader", daemon=True).start()

    def _load(self, session: Session, values: dict) -> None:
        """In a thread of its own: load the map, and have the executor's thread use it or go back to the old one."""
        try:
            loaded: Engine | Exception = session.engine.with_map(values)
        except Exception as error:  # whatever it is, the old map serves on
            loaded = error
        self.executor.create_task(self._use_map, session, loaded)

    def _use_map(self, session: Session, loaded: Engine | Exception) -> None:
        self._loading = ""
        if session is not self._session:
            return
        if isinstance(loaded, Engine):
            session.use_map(loaded)
            reason = f"the map is now {loaded.map_path}"
            self.get_logger().info(reason)
            self._reporter.diagnose("map", OK, reason, {"map": loaded.map_path})
            return
        old = session.engine.map_path
        reason = f"the map is still {old}: {loaded}"
        self.get_logger().error(reason)
        self._reporter.diagnose("map", ERROR, reason, {"map": old})
        self._going_back = True
        self.set_parameters([Parameter("map.path", value=old)])
        self._going_back = False

    # Time.

    def _on_time_jump(self, jump: TimeJump) -> None:
        now = self.get_clock().now().nanoseconds
        self.get_logger().warning(
            f"time went back by {-1e-9 * jump.delta.nanoseconds:.1f} s: what is stamped later is forgotten"
        )
        if self._session is not None:
            self._session.forget_after(now - _BACKWARDS.nanoseconds)
