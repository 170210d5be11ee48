"""Quality of service of the node's topics: parameters may override it, and what does not fit is reported."""

from __future__ import annotations

from collections import deque
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
# where the processor cannot keep up with taking them: no more than these are kept. DDS bounds their number (by default
# 5000), never their bytes, and tells nobody that it dropped one.
REQUESTS = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
IMAGE_REQUESTS = QoSProfile(depth=12)
# Messages of a topic between the two times that one comes.
_MAX_TWICE = 100


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
        latched: whether what was said before this node listened still holds, if its publisher keeps it.
        needed: whether nothing is localized without it.
    """

    message_type: type
    name: str
    qos: QoSProfile
    latched: bool = False
    needed: bool = False


@dataclass(eq=False)
class Listener:
    """A topic that is listened to.

    Attributes:
        topic: as it is asked for.
        callback: that takes what comes.
        subscriptions: the first is what every publisher should fit.
    """

    topic: Topic
    callback: Callable[..., None]
    subscriptions: list[Subscription]

    @property
    def name(self) -> str:
        """Of the topic, after remapping."""
        return self.subscriptions[0].topic_name

    @property
    def type_name(self) -> str:
        """Of the messages, as the graph has it."""
        message_type = self.topic.message_type
        return f"{message_type.__module__.split('.')[0]}/msg/{message_type.__name__}"

    @property
    def qos(self) -> QoSProfile:
        """That is asked for, overridden or not."""
        return self.subscriptions[0].qos_profile

    def hear_latched(self, node: Node) -> None:
        """Hear what a publisher said before, if it keeps that and it still holds.

        DDS gives that to those alone who ask for it, and to these nothing of who does not keep it, with a warning in
        its log: who only might be there is not asked.
        """
        if not self.topic.latched or len(self.subscriptions) > 1:
            return
        publishers = node.get_publishers_info_by_topic(self.name)
        kept = [p for p in publishers if p.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL]
        if any(publisher.topic_type == self.type_name for publisher in kept):
            message_type, name = self.topic.message_type, self.topic.name
            self.subscriptions.append(node.create_subscription(message_type, name, self.callback, LAST))


def subscribe(node: Node, topic: Topic, callback: Callable[[Any], None], refuse: Callable[[str], None]) -> Listener:
    """Subscribe with a QoS that can be overridden; `refuse` gets the reason why that of a publisher does not fit."""
    name = node.resolve_topic_name(topic.name)

    def incompatible(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        refuse(
            f"a publisher on {name} offers another {policy} than is asked for, nothing comes from it: set "
            f"qos_overrides.{name}.subscription.{policy} to what it offers (ros2 topic info --verbose {name})"
        )

    taken: Callable[..., None] = _once(callback) if topic.latched else callback
    first = node.create_subscription(
        topic.message_type,
        topic.name,
        taken,
        topic.qos,
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible),
        qos_overriding_options=overridable(),
    )
    return Listener(topic, taken, [first])


def _once(callback: Callable[[Any], None]) -> Callable[[Any, Any], None]:
    """Return a callback of two subscriptions to the same topic, to which a message may come twice."""
    seen: deque[int] = deque(maxlen=_MAX_TWICE)

    def take(message: Any, info: Any) -> None:
        stamp = info["source_timestamp"]
        if stamp not in seen:
            seen.append(stamp)
            callback(message)

    return take
