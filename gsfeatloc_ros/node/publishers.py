"""What is published when an image was localized, or was not: the pose, how far it may be off, tf, pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from threading import Lock

import numpy as np
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from gsfeatloc_ros.localize.estimate import Estimate, Trace
from gsfeatloc_ros.localize.protection import ProtectionLevel, protection_level
from gsfeatloc_ros.node.encode import image_message, pose_array_message, pose_message, protection_message
from gsfeatloc_ros.node.interfaces import ProtectionLevelMessage
from gsfeatloc_ros.node.qos import LATCHED, RELIABLE, overridable
from gsfeatloc_ros.node.transforms import Transforms
from gsfeatloc_ros.ros_io.compressed_image import PictureError
from gsfeatloc_ros.ros_io.debug_picture import draw, draw_refused
from gsfeatloc_ros.ros_io.decode import nanoseconds
from gsfeatloc_ros.ros_io.extrinsics import Extrinsics
from gsfeatloc_ros.ros_io.pictures import PictureReader
from gsfeatloc_ros.ros_io.settings import Settings

# Seconds between two broadcasts of the odometry's frame: as AMCL at the rate of a laser.
_TRANSFORM_PERIOD = 0.05
# What is shown for a picture that is not decoded.
_NO_PICTURE = np.zeros((480, 640, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class Answer:
    """An answer as it is published: of the camera, or of the base.

    Attributes:
        pose: with its covariance.
        protection: how far the pose may be off.
    """

    pose: PoseWithCovarianceStamped
    protection: ProtectionLevel


class Publishers:
    """Publishes on the node's topics, and the transform from the map to the odometry.

    Args:
        node: whose they are.
        settings: of the node.
        transforms: of the robot.
        silent: whether no transform is to be broadcast: nobody knows where the robot is, or the map's scale is wrong.

    Raises:
        ValueError: a transform is to be broadcast, but tf is not installed, or nobody said that the map is aligned, and
            it has to be.
    """

    def __init__(self, node: Node, settings: Settings, transforms: Transforms, silent: Callable[[], bool]) -> None:
        self._node, self._silent = node, silent
        self._transforms = transforms
        self._map_frame, self._frames = settings.map.frame_id, settings.node.answer_frames()
        self._tolerance = Duration(nanoseconds=int(1e9 * settings.node.transform_tolerance))
        self._T_map_odom: np.ndarray | None = None
        # An answer and the timer broadcast in threads of their own; stamps must not go back.
        self._broadcast_lock = Lock()
        # Of the image last answered, in nanoseconds.
        self.last_stamp: int | None = None
        settings.check_alignment()
        if self._frames.odom or self._frames.body or settings.recovery.planar:
            transforms.listen()
        self._pose = node.create_publisher(
            PoseWithCovarianceStamped, "pose", LATCHED, qos_overriding_options=overridable()
        )
        self._protection = None
        if ProtectionLevelMessage is not None:
            self._protection = node.create_publisher(
                ProtectionLevelMessage, "protection_level", LATCHED, qos_overriding_options=overridable()
            )
        self._render = node.create_publisher(Image, "rendered_image", RELIABLE, qos_overriding_options=overridable())
        self._debug = node.create_publisher(Image, "debug_image", RELIABLE, qos_overriding_options=overridable())
        self._candidates = node.create_publisher(
            PoseArray, "~/candidates", RELIABLE, qos_overriding_options=overridable()
        )
        self._searched = node.create_publisher(PoseArray, "~/searched", RELIABLE, qos_overriding_options=overridable())
        self._changed = node.create_publisher(Image, "~/changed", RELIABLE, qos_overriding_options=overridable())
        self._timer = node.create_timer(_TRANSFORM_PERIOD, self._broadcast) if self._frames.odom else None

    @property
    def topic(self) -> str:
        """Where poses are published."""
        return self._pose.topic_name

    def close(self) -> None:
        """Publish nothing more."""
        for publisher in (
            self._pose,
            self._protection,
            self._render,
            self._debug,
            self._changed,
            self._candidates,
            self._searched,
        ):
            if publisher is not None:
                self._node.destroy_publisher(publisher)
        if self._timer:
            self._node.destroy_timer(self._timer)

    def extrinsics(self, header: Header, shared: bool) -> Extrinsics:
        """Look up what is needed to publish the answer to an image; raise ValueError where tf does not know it.

        Args:
            header: the image's.
            shared: whether the answer is for all, tf among them.
        """
        return self._frames.extrinsics(self._transforms.lookup, header, shared)

    def answer(self, estimate: Estimate, extrinsics: Extrinsics, header: Header) -> Answer | None:
        """Return the answer to the image of a header; None where the estimate is none."""
        if estimate.T_map_camera is None or estimate.covariance is None:
            return None
        T_map_body, covariance = extrinsics.of_body(estimate.T_map_camera, estimate.covariance)
        pose = pose_message(T_map_body, covariance, Header(stamp=header.stamp, frame_id=self._map_frame))
        return Answer(pose, protection_level(covariance))

    def candidates(self, estimate: Estimate, extrinsics: Extrinsics, header: Header) -> PoseArray:
        """Return the poses that explain the image of a header about equally well, of the body that answers are of."""
        return self._poses(estimate.candidates, extrinsics, header)

    def publish_candidates(self, candidates: PoseArray) -> None:
        """Publish poses of which nobody knows which is the right one."""
        self._candidates.publish(candidates)

    def publish_answer(self, answer: Answer, T_map_camera: np.ndarray, extrinsics: Extrinsics) -> float:
        """Publish an answer, and from now on the transform that follows from it.

        Args:
            answer: to publish.
            T_map_camera: (4, 4).
            extrinsics: at the image's stamp.

        Returns:
            The seconds on the node's clock from the image's stamp to the pose; NaN where it has no stamp.
        """
        header = answer.pose.header
        self._pose.publish(answer.pose)
        stamp = nanoseconds(header.stamp)
        latency = 1e-9 * (self._node.get_clock().now().nanoseconds - stamp) if stamp else math.nan
        if self._protection is not None:
            self._protection.publish(protection_message(answer.protection, header))
        self.last_stamp = stamp
        T_map_odom = extrinsics.T_map_odom(T_map_camera)
        if T_map_odom is not None:
            self._T_map_odom = T_map_odom
            self._broadcast()
        return latency

    def publish_searched(self, trace: Trace, extrinsics: Extrinsics, header: Header) -> None:
        """Publish where the image of a header was looked for, if somebody subscribes."""
        if self._searched.get_subscription_count() > 0:
            self._searched.publish(self._poses(trace.searched, extrinsics, header))

    def publish_pictures(self, trace: Trace, header: Header) -> None:
        """Publish what there is to see of an image, each picture if somebody subscribes.

        They are the map seen from an answer; where the photo shows something else than the map, if a pose was found;
        and how the image was localized or why not.
        """
        localized, render = trace.estimate.localized, trace.render
        if localized and render is not None and self._render.get_subscription_count() > 0:
            self._render.publish(image_message(render.image(), header))
        if trace.changed is not None and self._changed.get_subscription_count() > 0:
            self._changed.publish(image_message(trace.changed(), header))
        if self._debug.get_subscription_count() > 0:
            self._debug.publish(image_message(draw(trace), header))

    def publish_refused(self, message: Image | CompressedImage, error: ValueError) -> None:
        """Publish an image that was not tried, with the reason, if somebody subscribes.

        A compressed picture that was refused for itself is not decoded for this: it may be one that takes long.
        """
        if self._debug.get_subscription_count() > 0:
            picture = _NO_PICTURE
            if isinstance(message, Image) or not isinstance(error, PictureError):
                with suppress(ValueError):
                    picture = PictureReader().decode(message)
            self._debug.publish(image_message(draw_refused(picture, str(error)), message.header))

    def forget(self) -> None:
        """Broadcast no more what follows from the last answer: time went back, or it is of another map."""
        self._T_map_odom = None

    def _poses(self, poses: Sequence[np.ndarray], extrinsics: Extrinsics, header: Header) -> PoseArray:
        """Return poses (4, 4) of the camera as those of the body that answers are of."""
        of_body = [pose @ extrinsics.T_camera_body for pose in poses]
        return pose_array_message(of_body, Header(stamp=header.stamp, frame_id=self._map_frame))

    def _broadcast(self) -> None:
        with self._broadcast_lock:
            T_map_odom = self._T_map_odom
            if T_map_odom is not None and not self._silent():
                stamp = (self._node.get_clock().now() + self._tolerance).to_msg()
                self._transforms.broadcast(self._map_frame, self._frames.odom, T_map_odom, stamp)
