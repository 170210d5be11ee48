"""What the node does while a map is loaded: messages in, Localizer.localize, messages out."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any

import rclpy.task
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import Trigger

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.localize.engine import Engine
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.node.diagnostics import ERROR, OK, WARN, Health, Reporter, evidence, stamp_text
from gsfeatloc_ros.node.parameters import Value, localizer_options, prior_policy
from gsfeatloc_ros.node.publishers import Answers
from gsfeatloc_ros.node.qos import NEWEST, ODOMETRY, RELIABLE, subscribe
from gsfeatloc_ros.node.transforms import Transforms
from gsfeatloc_ros.node.worker import Worker
from gsfeatloc_ros.ros_io.decode import decode_camera, nanoseconds, validate_image
from gsfeatloc_ros.ros_io.inputs import Inputs, RoughPose

try:
    from gsfeatloc_interfaces.srv import LocalizeImage
except ImportError:  # the package is optional: interfaces/ is built apart
    LocalizeImage = None

# How often the node says how it is, in seconds, as diagnostic_updater does.
_HEALTH_PERIOD = 1.0
_INACTIVE = "the node is not active: activate it (ros2 lifecycle set ... activate)"


@dataclass(frozen=True, eq=False)
class Job:
    """An image to localize.

    Attributes:
        message: the image.
        camera: of the image; None for that of the newest camera_info.
        rough: where it was taken; None for the newest prior.
        shared: whether the answer is for all, on the topics, or only for the one who asks.
    """

    message: Image | CompressedImage
    camera: Camera | None = None
    rough: RoughPose | None = None
    shared: bool = True


@dataclass(frozen=True, eq=False)
class Outcome:
    """How an attempt ended, for whoever asked for it.

    Attributes:
        status: that of the Estimate in words; "refused" if the image could not be tried, "error" for a bug met on it.
        reason: one sentence.
        estimate: None if the image could not be tried.
        pose: what is published of it; None unless localized.
    """

    status: str
    reason: str
    estimate: Estimate | None = None
    pose: PoseWithCovarianceStamped | None = None


class Session:
    """Localizes the newest image with the newest prior, and what services ask for before that.

    Callbacks only check and keep the newest message of each topic. One worker thread decodes and localizes. An image is
    paired with the camera_info and the prior that are the newest when the work on it starts; if one is missing then,
    the image is refused and not tried again when it comes.

    Args:
        node: whose topics and services they are.
        values: of all parameters by name.
        engine: that localizes.
        transforms: what tf knows; it stays when the session ends.
        reporter: to whom it is said how that goes.

    Raises:
        ValueError: the parameters do not go together, or tf is needed and not installed.
    """

    def __init__(
        self, node: Node, values: dict[str, Value], engine: Engine, transforms: Transforms, reporter: Reporter
    ) -> None:
        self._node, self._values, self._reporter = node, values, reporter
        self._engine, self._transforms = engine, transforms
        self._answers = Answers(node, values, self._transforms)
        self._compressed = values["image.transport"] == "compressed"
        # As image_transport does: a remapping of image holds for the compressed ones as well.
        self._image_topic = node.resolve_topic_name("image") + ("/compressed" if self._compressed else "")
        self._image_type = CompressedImage if self._compressed else Image
        self._no_image = f"no image yet: publish sensor_msgs/{self._image_type.__name__} on {self._image_topic}"
        self._inputs = Inputs(
            prior_policy(values),
            self._transforms.lookup,
            values["image.rectified"],
            f"no camera_info yet: publish sensor_msgs/CameraInfo on {node.resolve_topic_name('camera_info')}",
            f"no prior yet: publish geometry_msgs/PoseStamped on {node.resolve_topic_name('prior')}",
        )
        # The newest image, or why it cannot be used.
        self._job: Job | str = self._no_image
        self._prior_pending = False
        self._last_offered = 0
        self._health = Health()
        self._images_received = 0
        self._answers_given = 0
        self._unanswered_requests = 0
        self._active = False
        self._subscriptions: list[Subscription] = []
        self._worker: Worker[Job, Outcome] = Worker(self._attempt)
        # On a clock of its own: that of a simulation may stand still.
        self._timer = node.create_timer(
            _HEALTH_PERIOD, self._tell_health, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    # What the node asks for, in the executor's thread.

    def activate(self) -> None:
        """Listen."""

        def listen(message_type: type, topic: str, callback: Callable[[Any], None], qos: Any) -> None:
            complain = partial(self._refuse, f"qos of {topic}")
            self._subscriptions.append(subscribe(self._node, message_type, topic, callback, qos, complain))

        listen(self._image_type, self._image_topic if self._compressed else "image", self._on_image, NEWEST)
        listen(CameraInfo, "camera_info", self._on_camera_info, NEWEST)
        listen(PoseStamped, "prior", self._on_prior, RELIABLE)
        listen(PoseWithCovarianceStamped, "prior_with_covariance", self._on_prior, RELIABLE)
        listen(PoseWithCovarianceStamped, "initialpose", self._on_initial_pose, RELIABLE)
        if self._values["track"]:
            listen(Odometry, "odom", self._on_odometry, ODOMETRY)
        self._active = True
        topics = " ".join(subscription.topic_name for subscription in self._subscriptions)
        self._node.get_logger().info(
            f"ready: map {self._engine.map_path} (frame {self._values['map.frame_id']}), matcher "
            f"{self._values['matcher.name']}, on {self._engine.renderer.device}, {self._values['mode']}, "
            f"topics {topics} -> {self._answers.topic}"
        )
        self._diagnose(OK, "ready", f"ready: {self._no_image}", {})

    def deactivate(self) -> None:
        """Do not listen, and tell nothing more."""
        self._active = False
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        self._job = self._no_image
        self._answers.forget()

    def stop(self, timeout: float) -> bool:
        """Have the running localization given up; say whether it ended within `timeout` seconds.

        Requests that still wait are answered when the executor spins on.
        """
        return self._worker.stop(timeout)

    def close(self) -> None:
        """Take back all that was made, but for the subscriptions, which `deactivate` does."""
        self._node.destroy_timer(self._timer)
        self._answers.close()

    @property
    def unanswered_requests(self) -> int:
        """Number of requests in progress."""
        return self._unanswered_requests

    @property
    def engine(self) -> Engine:
        """That localizes."""
        return self._engine

    def use_map(self, engine: Engine) -> None:
        """Go on with the map of another engine; the last answer was in the old one's."""
        self._engine = engine.with_options(self._engine.options)
        self._inputs.forget_answer()
        self._answers.forget()

    def use_parameters(self, values: dict[str, Value]) -> None:
        """Go on with the values of all parameters, but for those that are read when the node is configured."""
        self._values = values
        self._inputs.policy = prior_policy(values)
        self._engine = self._engine.with_options(localizer_options(values))

    def forget_after(self, stamp: int) -> None:
        """Forget what is stamped later than `stamp` (nanoseconds): time went back."""
        self._transforms.forget()
        self._inputs.forget_after(stamp)
        self._answers.forget()

    # Callbacks, in the executor's thread.

    def _on_image(self, message: Image | CompressedImage) -> None:
        self._images_received += 1
        self._health.saw_image()
        try:
            if isinstance(message, Image):
                validate_image(message)
        except ValueError as error:
            self._job = str(error)
            self._refuse("image", str(error), message.header.stamp)
            return
        self._job = Job(message)
        if self._is_due(nanoseconds(message.header.stamp)):
            self._worker.offer(self._job)

    def _is_due(self, stamp: int) -> bool:
        """Whether an image is to be localized without being asked for."""
        mode, max_rate = self._values["mode"], self._values["max_rate"]
        stamp = stamp or self._node.get_clock().now().nanoseconds
        if mode == "on_request" or (mode == "on_prior" and not self._prior_pending):
            return False
        # Stamps that go back are those of a bag that starts anew.
        if max_rate and 0 <= stamp - self._last_offered < 1e9 / max_rate:
            return False
        self._prior_pending, self._last_offered = False, stamp
        return True

    def _on_camera_info(self, message: CameraInfo) -> None:
        self._take("camera_info", self._inputs.take_camera_info, message)

    def _on_prior(self, message: PoseStamped | PoseWithCovarianceStamped) -> None:
        self._prior_pending = self._take("prior", self._inputs.take_prior, message)

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._prior_pending = self._take("initialpose", partial(self._inputs.take_prior, name="initialpose"), message)

    def _on_odometry(self, message: Odometry) -> None:
        self._take("odom", self._inputs.take_odometry, message)

    def _take(self, topic: str, take: Callable[[Any], Any], message: Any) -> bool:
        """Take a message, or say why it cannot be; say whether it was."""
        try:
            take(message)
        except ValueError as error:
            self._inputs.lose(topic, str(error))
            self._refuse(topic, str(error), message.header.stamp)
            return False
        return True

    async def on_relocalize(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Localize the newest image."""
        problems = [] if isinstance(self._job, Job) else [self._job]
        if not problems and self._health.silence > self._values["image.timeout"]:
            problems = [f"the newest image came {self._health.silence:.1f} s ago: is the camera running?"]
        problems += self._inputs.missing
        if not self._active:
            problems = [_INACTIVE]
        if problems:
            response.success, response.message = False, "; ".join(problems)
            return response
        outcome = await self._outcome(self._job)
        response.success, response.message = outcome.pose is not None, outcome.reason
        return response

    async def on_localize_image(self, request: Any, response: Any) -> Any:
        """Localize the image of a LocalizeImage."""
        try:
            if not self._active:
                raise ValueError(_INACTIVE)
            validate_image(request.image)
            camera = decode_camera(request.camera_info, self._values["image.rectified"])
            rough = self._inputs.rough_pose(request.prior) if request.has_prior else None
            outcome = await self._outcome(Job(request.image, camera, rough, shared=False))
        except ValueError as error:
            outcome = Outcome("refused", str(error))
        estimate = outcome.estimate
        response.reason = outcome.reason
        response.status = getattr(response, outcome.status.upper(), response.REFUSED)
        if estimate is not None:
            response.inliers, response.milliseconds = estimate.inliers, estimate.milliseconds["total"]
        if outcome.pose is not None:
            response.pose = outcome.pose
        return response

    async def _outcome(self, job: Job) -> Outcome:
        """Have the worker do a job before all that comes by itself."""
        answer, executor = rclpy.task.Future(), self._node.executor

        def pass_on(done: Future[Outcome]) -> None:
            stopped = done.cancelled() or isinstance(done.exception(), Interrupted)
            outcome = Outcome("refused", "the node is stopping") if stopped else done.result()
            # Setting the answer in a task wakes the executor, which then resumes this coroutine.
            executor.create_task(answer.set_result, outcome)

        self._unanswered_requests += 1
        self._worker.request(job).add_done_callback(pass_on)
        outcome = await answer
        self._unanswered_requests -= 1
        return outcome

    # Work, in the worker's thread.

    def _attempt(self, job: Job, interrupted: Callable[[], bool]) -> Outcome:
        """Localize an image and tell what came of it; one diagnostic with its stamp, whatever happens."""
        stamp = stamp_text(job.message.header.stamp)
        try:
            outcome = self._localize(job, interrupted)
        except Interrupted:
            raise
        except Exception as error:
            # Not foreseen: a bug, or out of memory. The next image may well do.
            self._node.get_logger().error(f"localizing the image of {stamp} failed\n{traceback.format_exc()}")
            outcome = Outcome("error", f"{type(error).__name__}: {error}")
        if outcome.status in ("refused", "failed", "rejected"):
            self._reporter.complain(outcome.status, outcome.reason)
        levels = {"localized": OK, "refused": ERROR, "error": ERROR}
        values = {} if outcome.estimate is None else evidence(outcome.estimate)
        self._health.ended(outcome.status, outcome.reason, outcome.estimate)
        self._diagnose(levels.get(outcome.status, WARN), outcome.status, outcome.reason, {"stamp": stamp} | values)
        return outcome

    def _localize(self, job: Job, interrupted: Callable[[], bool]) -> Outcome:
        engine, header = self._engine, job.message.header
        try:
            query = self._inputs.query(job.message, job.camera, job.rough)
            mount = self._answers.mount(header, job.shared)
        except ValueError as error:
            if job.shared and self._active:
                self._answers.show_refused(job.message, str(error))
            return Outcome("refused", str(error))
        estimate = engine.localizer.localize(
            query.image, query.camera, query.T_map_camera_prior, query.prior_covariance, interrupted
        )
        if self._engine.renderer is not engine.renderer:
            return Outcome("refused", "the map was changed while this image was localized: send another")
        pose = self._answers.pose_message(estimate, mount, header) if estimate.localized else None
        if job.shared and self._active:
            if pose is not None:
                self._answers_given += 1
                self._answers.publish(pose, estimate, mount, query, engine, header)
                if self._values["track"]:
                    self._inputs.take_answer(estimate.T_map_camera, nanoseconds(job.message.header.stamp), query.rough)
            self._answers.show(estimate, query, engine, header)
        return Outcome(estimate.status.value, estimate.reason, estimate, pose)

    # Words, from either thread.

    def _refuse(self, subject: str, reason: str, stamp: Time | None = None) -> None:
        """Say what is wrong with what came on a topic, not more often than is useful."""
        if self._reporter.complain(subject, reason):
            self._diagnose(ERROR, "refused", reason, {"stamp": stamp_text(stamp)} if stamp else {})

    def _diagnose(self, level: bytes, status: str, reason: str, values: dict[str, str]) -> None:
        self._reporter.diagnose(
            "localization", level, reason, {"status": status, "reason": reason} | values | self._counts
        )

    @property
    def _counts(self) -> dict[str, str]:
        return {
            "images_received": str(self._images_received),
            "images_dropped": str(self._worker.dropped),
            "answers": str(self._answers_given),
        }

    def _tell_health(self) -> None:
        values, mode = self._values, self._values["mode"]
        level, reason = OK, "inactive"
        if self._active:
            level, reason = self._health.judge(values["image.timeout"], mode != "on_request", self._no_image)
        last = self._answers.last_stamp
        age = "nan" if last is None else f"{1e-9 * (self._node.get_clock().now().nanoseconds - last):.1f}"
        about = {"mode": mode, "map": self._engine.map_path, "device": self._engine.renderer.device, "answer_age": age}
        self._reporter.diagnose("health", level, reason, about | self._health.values() | self._counts)
