"""Quality of service of the node's topics: parameters may override it, and what does not fit is reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

# Only the newest image counts, and cameras publish with best effort.
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10)
# A pose is kept for those who subscribe later.
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Of what holds until something else is said, only that is kept.
LAST = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# All of it counts, and much may come while a map is loaded.
ODOMETRY = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
# Requests may come all at once: none is lost while another is taken. But those that hold images would fill the memory
# where the processor cannot keep up with taking them: no more than these are kept.
REQUESTS = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
IMAGE_REQUESTS = QoSProfile(depth=12)


def overridable() -> QoSOverridingOptions:
    """Let parameters such as qos_overrides./image.subscription.reliability say what the node asks for."""
    return QoSOverridingOptions(
        (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)
    )


@dataclass(frozen=True)
class Topic:
    """A topic that the node listens to.

    Attributes:
        message_type: of what comes on it.
        name: before remapping.
        qos: that is asked for.
    """

    message_type: type
    name: str
    qos: QoSProfile


def subscribe(node: Node, topic: Topic, callback: Callable[[Any], None], refuse: Callable[[str], None]) -> Subscription:
    """Subscribe with a QoS that can be overridden; `refuse` gets the reason why that of a publisher does not fit."""
    name = node.resolve_topic_name(topic.name)

    def incompatible(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        refuse(
            f"a publisher on {name} offers another {policy} than is asked for, nothing comes from it: set "
            f"qos_overrides.{name}.subscription.{policy} to what it offers (ros2 topic info --verbose {name})"
        )

    return node.create_subscription(
        topic.message_type,
        topic.name,
        callback,
        topic.qos,
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible),
        qos_overriding_options=overridable(),
    )
