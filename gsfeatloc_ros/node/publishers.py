"""What goes out when an image was localized, or was not: the pose, tf, pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from gsfeatloc_ros.common.geometry import shift_covariance
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.localize.engine import Engine
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.node.encode import image_message, pose_message
from gsfeatloc_ros.node.parameters import Value
from gsfeatloc_ros.node.qos import LATCHED, RELIABLE, overridable
from gsfeatloc_ros.node.transforms import Transforms
from gsfeatloc_ros.ros_io.debug_picture import draw, draw_refused
from gsfeatloc_ros.ros_io.decode import decode_picture, nanoseconds
from gsfeatloc_ros.ros_io.inputs import Query

# How often tf is told where the odometry's frame is, in seconds: as AMCL at the rate of a laser.
_TRANSFORM_PERIOD = 0.05


@dataclass(frozen=True, eq=False)
class Mount:
    """Where things of the robot were at an image's stamp, as far as it is needed to tell the answer.

    Attributes:
        T_camera_body: (4, 4) of the body that answers are poses of: the base, or the camera itself.
        T_camera_odom: (4, 4) of the odometry's frame; None where tf is not told.
    """

    T_camera_body: np.ndarray
    T_camera_odom: np.ndarray | None


class Answers:
    """Publishes on the topics pose, rendered_image and debug_image, and the transform from the map to the odometry.

    Args:
        node: whose they are.
        values: of all parameters by name.
        transforms: of the robot.

    Raises:
        ValueError: tf is to be told, but is not installed, or nobody said that the map is aligned.
    """

    def __init__(self, node: Node, values: dict[str, Value], transforms: Transforms) -> None:
        self._clock = node.get_clock()
        self._transforms = transforms
        self._map_frame, self._base_frame = values["map.frame_id"], values["base_frame"]
        self._of_base = values["pose_frame"] == "base"
        self._odom_frame = values["odom_frame"] if values["publish_tf"] else ""
        self._tolerance = Duration(nanoseconds=int(1e9 * values["transform_tolerance"]))
        self._T_map_odom: np.ndarray | None = None
        # Of the image last answered, in nanoseconds.
        self.last_stamp: int | None = None
        if self._odom_frame and not values["map.aligned"]:
            raise ValueError(
                "publish_tf needs map.aligned: set it to true once map.scale, map.translation and map.rotation put the "
                "map where the robot's map frame is; other nodes would believe a pose that is off"
            )
        if self._odom_frame or self._of_base:
            transforms.listen()
        self._pose = node.create_publisher(
            PoseWithCovarianceStamped, "pose", LATCHED, qos_overriding_options=overridable()
        )
        self._render = node.create_publisher(Image, "rendered_image", RELIABLE, qos_overriding_options=overridable())
        self._debug = node.create_publisher(Image, "debug_image", RELIABLE, qos_overriding_options=overridable())
        self._publishers = (self._pose, self._render, self._debug)
        self._node = node
        self._timer = node.create_timer(_TRANSFORM_PERIOD, self._broadcast) if self._odom_frame else None

    @property
    def topic(self) -> str:
        """Where poses are published."""
        return self._pose.topic_name

    def close(self) -> None:
        """Publish nothing more."""
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)
        if self._timer:
            self._node.destroy_timer(self._timer)

    def mount(self, header: Header, shared: bool) -> Mount:
        """What is needed to tell the answer to an image; raises ValueError where tf does not know it.

        Args:
            header: the image's.
            shared: whether the answer is for all, tf among them.
        """
        stamp, camera_frame = nanoseconds(header.stamp), header.frame_id
        T_camera_body, T_camera_odom = np.eye(4), None
        if self._of_base:
            T_camera_body = self._transforms.lookup(camera_frame, self._base_frame, stamp)
        if self._odom_frame and shared:
            T_camera_odom = self._transforms.lookup(camera_frame, self._odom_frame, stamp)
        return Mount(T_camera_body, T_camera_odom)

    def pose_message(self, estimate: Estimate, mount: Mount, header: Header) -> PoseWithCovarianceStamped:
        """The answer to the image of a header, from an estimate that was localized."""
        T_map_body = estimate.T_map_camera @ mount.T_camera_body
        lever = T_map_body[:3, 3] - estimate.T_map_camera[:3, 3]
        covariance = shift_covariance(estimate.covariance, lever)
        return pose_message(T_map_body, covariance, Header(stamp=header.stamp, frame_id=self._map_frame))

    def publish(
        self,
        pose: PoseWithCovarianceStamped,
        estimate: Estimate,
        mount: Mount,
        query: Query,
        engine: Engine,
        header: Header,
    ) -> None:
        """Tell an answer, and draw the map seen from there for those who look."""
        self._pose.publish(pose)
        self.last_stamp = nanoseconds(header.stamp)
        if mount.T_camera_odom is not None:
            self._T_map_odom = estimate.T_map_camera @ mount.T_camera_odom
            self._broadcast()
        if self._render.get_subscription_count() > 0:
            camera = query.camera.limited(engine.options.max_image_width)
            render = engine.renderer.render(camera, estimate.T_map_camera)
            self._render.publish(image_message(render.image(), header))

    def show(self, estimate: Estimate, query: Query, engine: Engine, header: Header) -> None:
        """Draw how an image was localized, or why not, for those who look."""
        if self._debug.get_subscription_count() > 0:
            photo = Photo.undistorted(query.image, query.camera, engine.options.max_image_width)
            self._debug.publish(image_message(draw(photo.image, estimate), header))

    def show_refused(self, message: Image | CompressedImage, reason: str) -> None:
        """The same for an image that was not tried, if it is one."""
        if self._debug.get_subscription_count() > 0:
            try:
                image = decode_picture(message)
            except ValueError:
                return
            self._debug.publish(image_message(draw_refused(image, reason), message.header))

    def forget(self) -> None:
        """Tell tf no more of the last answer: time went back, or it is of another map."""
        self._T_map_odom = None

    def _broadcast(self) -> None:
        T_map_odom = self._T_map_odom
        if T_map_odom is not None:
            stamp = (self._clock.now() + self._tolerance).to_msg()
            self._transforms.broadcast(self._map_frame, self._odom_frame, T_map_odom, stamp)
