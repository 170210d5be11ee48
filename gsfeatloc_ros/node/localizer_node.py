"""The ROS node: messages in, Localizer.localize, messages out."""

from __future__ import annotations

import time
import traceback
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import rclpy.task
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.estimate import Estimate
from gsfeatloc_ros.localize import Localizer
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.messages import (
    Prior,
    decode_camera,
    decode_compressed_image,
    decode_image,
    decode_prior,
    decode_prior_covariance,
    validate_image,
)
from gsfeatloc_ros.node.diagnostics import ERROR, OK, WARN, diagnostic_message, evidence, stamp_text
from gsfeatloc_ros.node.messages import image_message, pose_message
from gsfeatloc_ros.node.parameters import TRANSPORTS, declare_parameters, localizer_options, map_alignment
from gsfeatloc_ros.node.worker import LatestWorker
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.render.cache import load_prepared
from gsfeatloc_ros.warmup import warm_up

# Only the newest image counts, and cameras publish with best effort.
_NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_RELIABLE = QoSProfile(depth=10)
# A pose is kept for those who subscribe later.
_LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# A camera that sends 30 unusable images a second must not flood the log and /diagnostics.
_SECONDS_BETWEEN_COMPLAINTS = 1.0

T = TypeVar("T")


@dataclass(frozen=True)
class Newest(Generic[T]):
    """What the newest message of a topic holds, or why there is nothing to use.

    A message that cannot be used takes the place of an older good one: what is old is not passed off as new.
    """

    value: T | None = None
    problem: str = ""

    def get(self) -> T:
        """The value; raises ValueError with the problem where there is none."""
        if self.value is None:
            raise ValueError(self.problem)
        return self.value


class Outcome(NamedTuple):
    """How an attempt ended, for whoever asked for it."""

    localized: bool
    reason: str


class LocalizerNode(Node):
    """Localizes the newest image with the newest prior.

    Callbacks only check and keep the newest message of each topic. One worker thread decodes and localizes. An image is
    paired with the camera_info and the prior that are the newest when the work on it starts; if one is missing then,
    the image is refused and not tried again when it comes.

    Raises:
        ValueError, OSError, RuntimeError, rclpy.exceptions.ParameterException: the parameters, the map or the matcher's
            weights cannot be used; the message says why.
    """

    def __init__(self) -> None:
        super().__init__("localizer")
        values = declare_parameters(self)
        self._map_frame = values["map.frame_id"]
        self._rectified = values["image.rectified"]
        transport = values["image.transport"]
        if transport not in TRANSPORTS:
            raise ValueError(f"parameter image.transport is {transport!r}: set {' or '.join(TRANSPORTS)}")
        self._options = localizer_options(values)
        if not values["map.path"]:
            raise ValueError("parameter map.path is empty: set it to a map file (-p map.path:=/path/to/map.ply)")
        load = load_prepared if values["map.cache"] else load_map
        gaussian_map = load(values["map.path"], map_alignment(values))
        self._renderer = create_renderer(
            gaussian_map,
            values["renderer.device"],
            values["renderer.threads"],
            sh_degree=values["renderer.sh_degree"],
            resolution_scale=values["renderer.resolution_scale"],
        )
        matcher = create_matcher(values["matcher.name"], values["matcher.weights"], values["matcher.max_features"])
        self._localizer = Localizer(self._renderer, matcher, self._options)
        # Now, not at the first image: it takes long.
        warm_up(matcher, values["renderer.device"], values["renderer.threads"])

        self._worker = LatestWorker(self._attempt)
        self._images_received = 0
        self._answers = 0
        self._unanswered_requests = 0
        self._next_complaint: dict[str, float] = {}

        self._pose_publisher = self.create_publisher(PoseWithCovarianceStamped, "pose", _LATCHED)
        self._render_publisher = self.create_publisher(Image, "rendered_image", _RELIABLE)
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", _RELIABLE)
        if transport == "compressed":
            # As image_transport does: a remapping of image holds for it as well.
            topic = self.resolve_topic_name("image") + "/compressed"
            image = self.create_subscription(CompressedImage, topic, self._on_image, _NEWEST)
        else:
            image = self.create_subscription(Image, "image", self._on_image, _NEWEST)
        camera = self.create_subscription(CameraInfo, "camera_info", self._on_camera_info, _NEWEST)
        prior = self.create_subscription(PoseStamped, "prior", self._on_prior, _RELIABLE)
        self.create_subscription(PoseWithCovarianceStamped, "prior_with_covariance", self._on_prior, _RELIABLE)
        self._image: Newest[Image | CompressedImage] = Newest(
            problem=f"no image yet: publish sensor_msgs/{image.msg_type.__name__} on {image.topic_name}"
        )
        self._camera: Newest[Camera] = Newest(
            problem=f"no camera_info yet: publish sensor_msgs/CameraInfo on {camera.topic_name}"
        )
        self._prior: Newest[Prior] = Newest(
            problem=f"no prior yet: publish geometry_msgs/PoseStamped on {prior.topic_name}"
        )
        # Reentrant: a request that waits for the worker must not hold up the next one.
        self.create_service(Trigger, "~/relocalize", self._on_relocalize, callback_group=ReentrantCallbackGroup())
        self.get_logger().info(
            f"ready: map {values['map.path']} (frame {self._map_frame}), "
            f"matcher {values['matcher.name']}, renderer {values['renderer.device']}, "
            f"topics {image.topic_name} {camera.topic_name} {prior.topic_name} -> {self._pose_publisher.topic_name}"
        )
        self._diagnose(OK, "ready", f"ready: {self._image.problem}", {})

    def stop(self, timeout: float) -> bool:
        """Let the running localization end, for up to `timeout` seconds; say whether it did.

        Requests that still wait are answered when the executor spins on.
        """
        return self._worker.stop(timeout)

    @property
    def unanswered_requests(self) -> int:
        """Number of relocalize requests in progress."""
        return self._unanswered_requests

    # Callbacks, in the executor's thread.

    def _on_image(self, message: Image | CompressedImage) -> None:
        self._images_received += 1
        try:
            if isinstance(message, Image):
                validate_image(message)
        except ValueError as error:
            self._image = Newest(problem=str(error))
            self._refuse("image", str(error), message.header.stamp)
        else:
            self._image = Newest(message)
            self._worker.submit(message)

    def _on_camera_info(self, message: CameraInfo) -> None:
        try:
            self._camera = Newest(decode_camera(message, self._rectified))
        except ValueError as error:
            self._camera = Newest(problem=str(error))
            self._refuse("camera_info", str(error), message.header.stamp)

    def _on_prior(self, message: PoseStamped | PoseWithCovarianceStamped) -> None:
        try:
            self._prior = Newest(Prior(decode_prior(message, self._map_frame), decode_prior_covariance(message)))
        except ValueError as error:
            self._prior = Newest(problem=str(error))
            self._refuse("prior", str(error), message.header.stamp)

    async def _on_relocalize(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        missing = [newest.problem for newest in (self._image, self._camera, self._prior) if newest.value is None]
        if missing:
            response.success, response.message = False, "; ".join(missing)
            return response
        answer, executor = rclpy.task.Future(), self.executor

        def pass_on(done: Future[Outcome]) -> None:
            outcome = Outcome(False, "the node is stopping") if done.cancelled() else done.result()
            # Setting the answer in a task wakes the executor, which then resumes this coroutine.
            executor.create_task(answer.set_result, outcome)

        self._unanswered_requests += 1
        self._worker.submit(self._image.value).add_done_callback(pass_on)
        response.success, response.message = await answer
        self._unanswered_requests -= 1
        return response

    # Work, in the worker's thread.

    def _attempt(self, message: Image | CompressedImage) -> Outcome:
        """Localize an image and publish what came of it; one diagnostic with its stamp, whatever happens."""
        stamp = message.header.stamp
        try:
            return self._localize(message)
        except Exception as error:
            # Not foreseen: a bug, or out of memory. The next image may well do.
            reason = f"{type(error).__name__}: {error}"
            self.get_logger().error(f"localizing the image of {stamp_text(stamp)} failed\n{traceback.format_exc()}")
            self._diagnose(ERROR, "error", reason, {"stamp": stamp_text(stamp)})
            return Outcome(False, reason)

    def _localize(self, message: Image | CompressedImage) -> Outcome:
        values = {"stamp": stamp_text(message.header.stamp)}
        try:
            camera, prior = self._camera.get(), self._prior.get()
            image = decode_image(message) if isinstance(message, Image) else decode_compressed_image(message)
            height, width = image.shape[:2]
            if (camera.width, camera.height) != (width, height):
                raise ValueError(
                    f"camera_info is for {camera.width}x{camera.height} but the image is {width}x{height}: publish the "
                    "camera_info of this image"
                )
        except ValueError as error:
            self._complain("refused", str(error))
            self._diagnose(ERROR, "refused", str(error), values)
            return Outcome(False, str(error))
        estimate = self._localizer.localize(image, camera, prior.T_map_camera, prior.covariance)
        if estimate.localized:
            self._publish(estimate, camera, message.header)
        else:
            self._complain("failed", estimate.reason)
        level = OK if estimate.localized else WARN
        self._diagnose(level, estimate.status.value, estimate.reason, values | evidence(estimate))
        return Outcome(estimate.localized, estimate.reason)

    def _publish(self, estimate: Estimate, camera: Camera, image_header: Header) -> None:
        self._answers += 1
        header = Header(stamp=image_header.stamp, frame_id=self._map_frame)
        self._pose_publisher.publish(pose_message(estimate, header))
        if self._render_publisher.get_subscription_count() > 0:
            render = self._renderer.render(camera.limited(self._options.max_image_width), estimate.T_map_camera)
            self._render_publisher.publish(image_message(render.image(), image_header))

    # Words, from either thread.

    def _refuse(self, topic: str, reason: str, stamp: Time) -> None:
        """Say what is wrong with a message of `topic`, not more often than is useful."""
        if self._complain(topic, reason):
            self._diagnose(ERROR, "refused", reason, {"stamp": stamp_text(stamp)})

    def _complain(self, subject: str, reason: str) -> bool:
        """Log a warning; False when the last one on `subject` was not long enough ago."""
        now = time.monotonic()
        if now < self._next_complaint.get(subject, 0.0):
            return False
        self._next_complaint[subject] = now + _SECONDS_BETWEEN_COMPLAINTS
        self.get_logger().warning(reason)
        return True

    def _diagnose(self, level: bytes, status: str, reason: str, values: dict[str, str]) -> None:
        counts = {
            "images_received": str(self._images_received),
            "images_dropped": str(self._worker.dropped),
            "answers": str(self._answers),
        }
        name = f"{self.get_fully_qualified_name().lstrip('/')}: localization"
        now = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(diagnostic_message(now, name, level, status, reason, values | counts))
