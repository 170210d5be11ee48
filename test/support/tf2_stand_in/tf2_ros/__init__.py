"""A stand-in for tf2_ros in pure Python, for tests where only ROS's wheels are: these have no tf2.

Of the real one it has what gsfeatloc_ros uses, with its topics, QoS and answers; test_transforms.py holds for both.
"""

from __future__ import annotations

from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from tf2_ros.buffer import Buffer
from tf2_ros.exceptions import (
    ConnectivityException,
    ExtrapolationException,
    InvalidArgumentException,
    LookupException,
    TransformException,
)

__all__ = [
    "Buffer",
    "ConnectivityException",
    "ExtrapolationException",
    "InvalidArgumentException",
    "LookupException",
    "StaticTransformBroadcaster",
    "TransformBroadcaster",
    "TransformException",
    "TransformListener",
]


class TransformListener:
    """Tells a buffer what comes on /tf and /tf_static."""

    def __init__(self, buffer: Buffer, node: Node) -> None:
        group = ReentrantCallbackGroup()
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._buffer = buffer
        node.create_subscription(TFMessage, "/tf", self._on_tf, QoSProfile(depth=100), callback_group=group)
        node.create_subscription(TFMessage, "/tf_static", self._on_tf_static, latched, callback_group=group)

    def _on_tf(self, message: TFMessage) -> None:
        for transform in message.transforms:
            self._buffer.set_transform(transform, "default_authority")

    def _on_tf_static(self, message: TFMessage) -> None:
        for transform in message.transforms:
            self._buffer.set_transform_static(transform, "default_authority")


class TransformBroadcaster:
    """Publishes on /tf."""

    def __init__(self, node: Node) -> None:
        self._publisher = node.create_publisher(TFMessage, "/tf", QoSProfile(depth=100))

    def sendTransform(self, transform: TransformStamped | list[TransformStamped]) -> None:
        self._publisher.publish(TFMessage(transforms=transform if isinstance(transform, list) else [transform]))


class StaticTransformBroadcaster:
    """Publishes on /tf_static, where the last message counts: it holds all that was sent."""

    def __init__(self, node: Node) -> None:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = node.create_publisher(TFMessage, "/tf_static", latched)
        self._sent: dict[str, TransformStamped] = {}

    def sendTransform(self, transform: TransformStamped | list[TransformStamped]) -> None:
        for item in transform if isinstance(transform, list) else [transform]:
            self._sent.setdefault(item.child_frame_id, item)
        self._publisher.publish(TFMessage(transforms=list(self._sent.values())))
