"""The services ~/relocalize, ~/localize_image and reinitialize_global_localization."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from functools import partial
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_srvs.srv import Empty, Trigger

from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.node.attempts import Job, JobResult
from gsfeatloc_ros.node.executor import Later
from gsfeatloc_ros.node.interfaces import LocalizeImage
from gsfeatloc_ros.node.qos import IMAGE_REQUESTS, REQUESTS
from gsfeatloc_ros.node.session import Session
from gsfeatloc_ros.node.worker import UnservedError
from gsfeatloc_ros.ros_io.calibration import decode_camera
from gsfeatloc_ros.ros_io.outcome import Outcome, OutcomeStatus
from gsfeatloc_ros.ros_io.prior import PriorSource, decode_prior
from gsfeatloc_ros.ros_io.raw_image import validate_image

_UNCONFIGURED = "the node is not configured: configure and activate it (ros2 lifecycle set ... configure)"
_INACTIVE = "the node is not active: activate it (ros2 lifecycle set ... activate)"


class Services:
    """Answers requests; all of it runs in the executor's thread.

    They outlive a session, whose last answers would find no service to be sent by.

    Args:
        node: whose services they are.
        session: returns the one that there is now, if any.
        on_failure: is told each exception that nobody foresaw.

    Attributes:
        unanswered: number of requests in progress.
    """

    def __init__(
        self, node: Node, session: Callable[[], Session | None], on_failure: Callable[[Exception], None]
    ) -> None:
        self._node, self._session, self._on_failure = node, session, on_failure
        self.unanswered = 0
        # Reentrant: a request that waits for the worker must not hold up the next one.
        self._group = ReentrantCallbackGroup()
        self._create(Trigger, "~/relocalize", self._on_relocalize, REQUESTS)
        # Of this name, in the node's namespace, as AMCL has it: Nav2's recovery calls it.
        self._create(Empty, "reinitialize_global_localization", self._on_reinitialize, REQUESTS)
        if LocalizeImage is None:
            node.get_logger().info(
                "the service ~/localize_image and the topic protection_level are off: build the package "
                "gsfeatloc_interfaces (interfaces/), source it"
            )
        else:
            self._create(LocalizeImage, "~/localize_image", self._on_localize_image, IMAGE_REQUESTS)

    def _on_relocalize(self, request: Trigger.Request, response: Trigger.Response) -> Later:
        """Localize the newest image."""

        def fill(result: JobResult) -> Trigger.Response:
            response.success, response.message = result.answer is not None, result.outcome.reason
            return response

        return self._later("~/relocalize", lambda session: session.reception.newest(), fill)

    def _on_reinitialize(self, request: Empty.Request, response: Empty.Response) -> Empty.Response:
        """Forget where the robot is."""
        session = self._session()
        if session is None:
            self._node.get_logger().warning(f"reinitialize_global_localization: {_UNCONFIGURED}")
        else:
            session.lose("asked for by reinitialize_global_localization")
        return response

    def _on_localize_image(self, request: Any, response: Any) -> Later:
        """Localize the image of a LocalizeImage."""
        return self._later(
            "~/localize_image", lambda session: _requested_job(request, session), partial(_filled, response)
        )

    def _active_session(self) -> Session:
        session = self._session()
        if session is None:
            raise ValueError(_UNCONFIGURED)
        if not session.active:
            raise ValueError(_INACTIVE)
        return session

    def _create(self, service_type: type, name: str, callback: Callable[[Any, Any], Any], qos: QoSProfile) -> None:
        self._node.create_service(service_type, name, callback, qos_profile=qos, callback_group=self._group)

    def _later(self, service: str, make: Callable[[Session], Job], fill: Callable[[JobResult], Any]) -> Later:
        """Request the job that a request to a service makes, and return the response that is filled when it is done."""
        self.unanswered += 1
        try:
            session = self._active_session()
            done = session.attempts.request(make(session), session.settings.requests, lambda: self._has_client(service))
        except Exception as error:
            done = Future()
            done.set_exception(error)
        return Later(done, lambda: fill(self._result(service, done)))

    def _result(self, service: str, done: Future[JobResult]) -> JobResult:
        """Return what came of a job that was requested of a service; whatever happened, there is an answer."""
        self.unanswered -= 1
        try:
            return done.result()
        except ValueError as error:
            return JobResult(Outcome.refused(error))
        except UnservedError as error:
            outcome = Outcome.busy(f"{error}: ask again later, or less often (parameters requests.*)")
            session = self._session()
            if session is not None:
                session.report.count_unserved(service, outcome.reason)
            return JobResult(outcome)
        except (CancelledError, Interrupted):
            return JobResult(Outcome.refused("the node is stopping"))
        except Exception as error:
            self._on_failure(error)
            return JobResult(Outcome.error(error))

    def _has_client(self, service: str) -> bool:
        """Return whether there is any client of a service; rclpy does not tell whose a request is."""
        return self._node.count_clients(self._node.resolve_service_name(service)) > 0


def _requested_job(request: Any, session: Session) -> Job:
    """Return the job that a LocalizeImage asks for; raise ValueError where it cannot be done."""
    settings = session.settings
    validate_image(request.image)
    camera = decode_camera(request.camera_info, settings.image.rectified)
    prior = None
    if request.has_prior:
        prior = decode_prior(request.prior, PriorSource.REQUEST, settings.prior_policy())
    if not (math.isfinite(request.max_seconds) and request.max_seconds >= 0):
        raise ValueError(f"max_seconds is {request.max_seconds}: 0 for the parameter's, or more")
    inputs = session.inputs.newest()
    kept = not request.forget
    return Job(request.image, camera, prior, inputs, shared=False, kept=kept, max_seconds=request.max_seconds)


def _filled(response: Any, result: JobResult) -> Any:
    """Return the response of a LocalizeImage, filled with what came of its job."""
    outcome, answer = result.outcome, result.answer
    response.status = {
        OutcomeStatus.LOCALIZED: response.LOCALIZED,
        OutcomeStatus.REJECTED: response.REJECTED,
        OutcomeStatus.FAILED: response.FAILED,
        OutcomeStatus.REFUSED: response.REFUSED,
        OutcomeStatus.BUSY: response.BUSY,
        OutcomeStatus.ERROR: response.ERROR,
        OutcomeStatus.AMBIGUOUS: response.AMBIGUOUS,
    }[outcome.status]
    response.reason = outcome.reason
    response.probability_wrong = response.protection_radius = response.protection_angle = math.nan
    if outcome.estimate is not None:
        response.inliers = outcome.estimate.evidence.inliers
        response.milliseconds = outcome.estimate.milliseconds["total"]
        response.probability_wrong = outcome.estimate.evidence.probability_wrong
    if result.candidates is not None:
        response.candidates = result.candidates
    if answer is not None:
        response.pose = answer.pose
        response.protection_radius, response.protection_angle = answer.protection.radius, answer.protection.angle
    return response
