"""The services ~/relocalize, ~/localize_image and reinitialize_global_localization."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import rclpy.task
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Empty, Trigger

from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.node.attempts import Attempts, Job, JobResult
from gsfeatloc_ros.node.interfaces import LocalizeImage
from gsfeatloc_ros.node.session import Session
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

    Attributes:
        unanswered: number of requests in progress.
    """

    def __init__(self, node: Node, session: Callable[[], Session | None]) -> None:
        self._node, self._session = node, session
        self.unanswered = 0
        # Reentrant: a request that waits for the worker must not hold up the next one.
        group = ReentrantCallbackGroup()
        node.create_service(Trigger, "~/relocalize", self._on_relocalize, callback_group=group)
        # Of this name, in the node's namespace, as AMCL has it: Nav2's recovery calls it.
        node.create_service(Empty, "reinitialize_global_localization", self._on_reinitialize)
        if LocalizeImage is None:
            node.get_logger().info(
                "the service ~/localize_image and the topic protection_level are off: build the package "
                "gsfeatloc_interfaces (interfaces/), source it"
            )
        else:
            node.create_service(LocalizeImage, "~/localize_image", self._on_localize_image, callback_group=group)

    async def _on_relocalize(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Localize the newest image."""
        try:
            session = self._active_session()
            result = await self._result(session.attempts, session.reception.newest())
        except ValueError as error:
            result = JobResult(Outcome.refused(error))
        response.success, response.message = result.answer is not None, result.outcome.reason
        return response

    def _on_reinitialize(self, request: Empty.Request, response: Empty.Response) -> Empty.Response:
        """Forget where the robot is."""
        session = self._session()
        if session is None:
            self._node.get_logger().warning(f"reinitialize_global_localization: {_UNCONFIGURED}")
        else:
            session.lose("asked for by reinitialize_global_localization")
        return response

    async def _on_localize_image(self, request: Any, response: Any) -> Any:
        """Localize the image of a LocalizeImage."""
        try:
            session = self._active_session()
            result = await self._result(session.attempts, _requested_job(request, session))
        except ValueError as error:
            result = JobResult(Outcome.refused(error))
        outcome, answer = result.outcome, result.answer
        response.status = {
            OutcomeStatus.LOCALIZED: response.LOCALIZED,
            OutcomeStatus.REJECTED: response.REJECTED,
            OutcomeStatus.FAILED: response.FAILED,
            OutcomeStatus.REFUSED: response.REFUSED,
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

    def _active_session(self) -> Session:
        session = self._session()
        if session is None:
            raise ValueError(_UNCONFIGURED)
        if not session.active:
            raise ValueError(_INACTIVE)
        return session

    async def _result(self, attempts: Attempts, job: Job) -> JobResult:
        """Have a job done before all that comes by itself."""
        answer, executor = rclpy.task.Future(), self._node.executor
        assert executor is not None  # this is run by it

        def pass_on(done: Future[JobResult]) -> None:
            stopped = done.cancelled() or isinstance(done.exception(), Interrupted)
            result = JobResult(Outcome.refused("the node is stopping")) if stopped else done.result()
            # Setting the answer in a task wakes the executor, which then resumes this coroutine.
            executor.create_task(answer.set_result, result)

        self.unanswered += 1
        attempts.request(job).add_done_callback(pass_on)
        result = await answer
        self.unanswered -= 1
        return result


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
    return Job(request.image, camera, prior, shared=False, kept=not request.forget, max_seconds=request.max_seconds)
