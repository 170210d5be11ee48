"""What a running localizer says, for the page of gsfeatloc view; and priors to it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, Image

from gsfeatloc_ros.client.client_node import ClientNode
from gsfeatloc_ros.client.messages import pose_with_covariance, read_diagnostics
from gsfeatloc_ros.node.qos import LATCHED, RELIABLE
from gsfeatloc_ros.ros_io.decode import decode_covariance, decode_pose, nanoseconds
from gsfeatloc_ros.ros_io.raw_image import decode_image
from gsfeatloc_ros.ros_io.settings import BASE
from gsfeatloc_ros.view.attempts import Attempt, Prior
from gsfeatloc_ros.view.jpeg import encoded
from gsfeatloc_ros.view.store import Store

# Seconds after which the node is asked again of what its priors are: it may have been started anew.
_ASKED_EVERY = 2.0


class LiveNode(ClientNode):
    """Listens to a localizer in a thread of its own, and fills a store.

    Args:
        localizer: name of its node, with its namespace if it has one.
        frame: of the map: poses in another are left out.
        store: to fill.
        arguments: of ROS: --ros-args with remappings.
    """

    def __init__(self, localizer: str, frame: str, store: Store, arguments: Sequence[str] = ()) -> None:
        namespace, _, name = localizer.strip("/").rpartition("/")
        super().__init__("gsfeatloc_view", f"/{namespace}", arguments)
        self._frame, self._store = frame, store
        self._status = f"{localizer.strip('/')}: localization"
        self._priors = {
            topic: self.node.create_publisher(PoseWithCovarianceStamped, topic, RELIABLE)
            for topic in ("initialpose", "prior_with_covariance")
        }
        self._listen(PoseWithCovarianceStamped, "pose", self._on_pose, LATCHED)
        self._listen(DiagnosticArray, "/diagnostics", self._on_diagnostics)
        self._listen(PoseArray, f"{name}/candidates", self._on_candidates)
        self._listen(PoseArray, f"{name}/searched", self._on_searched)
        self._listen(Image, "debug_image", self._on_debug_image)
        # Of what priors are, and the camera's frame, once that is known; until then, the prior that waits for it.
        self._prior_frame = self._camera_frame = ""
        self._waiting: PoseStamped | PoseWithCovarianceStamped | Odometry | None = None
        self._listen(PoseStamped, "prior", self._on_prior)
        self._listen(PoseWithCovarianceStamped, "prior_with_covariance", self._on_prior)
        self._listen(PoseWithCovarianceStamped, "initialpose", partial(self._add_prior, of_base=True))
        self._listen(Odometry, "prior_odometry", self._on_prior)
        self._listen(CameraInfo, "camera_info", self._on_camera_info, qos_profile_sensor_data)
        self._parameters = self.node.create_client(GetParameters, f"{name}/get_parameters")
        self.node.create_timer(_ASKED_EVERY, self._ask)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the graph."""
        self._stopped.set()
        self._thread.join()
        super().close()

    def send_base(self, pose: np.ndarray, covariance: np.ndarray) -> str:
        """Send a pose (4, 4) of the base with its covariance (6, 6), as RViz does; return what was sent where."""
        return self._send("initialpose", pose, covariance)

    def send_camera(self, pose: np.ndarray, covariance: np.ndarray) -> str:
        """Send a pose (4, 4) of the camera with its covariance (6, 6); return what was sent where."""
        return self._send("prior_with_covariance", pose, covariance)

    def _listen(self, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile = RELIABLE) -> None:
        """Call back with what comes; what cannot be used is left out: the localizer says so itself."""

        def take(message: Any) -> None:
            with contextlib.suppress(ValueError):
                callback(message)

        self.node.create_subscription(kind, topic, take, qos)

    def _send(self, topic: str, pose: np.ndarray, covariance: np.ndarray) -> str:
        publisher = self._priors[topic]
        message = pose_with_covariance(pose, covariance, self._frame)
        message.header.stamp = self.node.get_clock().now().to_msg()
        publisher.publish(message)
        listeners = publisher.get_subscription_count()
        # One of them is this node itself, which has it drawn.
        return f"sent on {publisher.topic_name}" + ("" if listeners > 1 else ", but nobody listens there")

    # In the thread.

    def _run(self) -> None:
        self.spin_until(self._stopped.is_set, float("inf"))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        if message.header.frame_id == self._frame:
            stamp, pose = nanoseconds(message.header.stamp), decode_pose(message, "pose")
            self._store.add(Attempt(stamp, "", "", pose, decode_covariance(message, "pose")))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for diagnostic in read_diagnostics(message):
            stamp = diagnostic.values.get("stamp", "")
            if diagnostic.name == self._status and stamp:
                seconds, _, rest = stamp.partition(".")
                nanos = int(seconds) * 10**9 + int(rest.ljust(9, "0"))
                self._store.add(Attempt(nanos, diagnostic.values["status"], diagnostic.reason))

    def _on_candidates(self, message: PoseArray) -> None:
        if message.header.frame_id == self._frame:
            self._store.add(Attempt(nanoseconds(message.header.stamp), "", "", candidates=_poses(message)))

    def _on_searched(self, message: PoseArray) -> None:
        if message.header.frame_id == self._frame:
            self._store.add(Attempt(nanoseconds(message.header.stamp), "", "", searched=_poses(message)))

    def _on_debug_image(self, message: Image) -> None:
        self._store.add_picture(nanoseconds(message.header.stamp), encoded(decode_image(message)))

    def _ask(self) -> None:
        if self._parameters.service_is_ready():
            request = GetParameters.Request(names=["prior_frame"])
            self._parameters.call_async(request).add_done_callback(self._on_parameters)

    def _on_parameters(self, answer: Future) -> None:
        self._prior_frame = answer.result().values[0].string_value
        with contextlib.suppress(ValueError):
            self._add_waiting()

    def _on_camera_info(self, message: CameraInfo) -> None:
        self._camera_frame = message.header.frame_id
        self._add_waiting()

    def _on_prior(self, message: PoseStamped | PoseWithCovarianceStamped | Odometry) -> None:
        self._waiting = message
        self._add_waiting()

    def _add_waiting(self) -> None:
        """Add the prior that waits, if it is known of what it is."""
        message = self._waiting
        if isinstance(message, Odometry):
            known, of_base = self._camera_frame, message.child_frame_id != self._camera_frame
        else:
            known, of_base = self._prior_frame, self._prior_frame == BASE
        if message is not None and known:
            self._waiting = None
            self._add_prior(message, of_base)

    def _add_prior(self, message: PoseStamped | PoseWithCovarianceStamped | Odometry, of_base: bool) -> None:
        if message.header.frame_id == self._frame:
            self._store.add_prior(Prior(decode_pose(message, "prior"), of_base))


def _poses(message: PoseArray) -> np.ndarray:
    """Return the poses (N, 4, 4) of a message."""
    poses = [decode_pose(PoseStamped(header=message.header, pose=pose), "pose") for pose in message.poses]
    return np.array(poses).reshape(-1, 4, 4)
