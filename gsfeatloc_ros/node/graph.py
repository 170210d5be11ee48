"""What the ROS graph tells of an input that does not come: nobody publishes it, or something else, or otherwise."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible

from gsfeatloc_ros.node.diagnostics import Reporter
from gsfeatloc_ros.node.qos import Listener
from gsfeatloc_ros.ros_io.settings import COMPRESSED, ON_PRIOR, ON_REQUEST

# Seconds after it began to listen in which nothing is said in the log: publishers have to be found first.
_PATIENCE = 5.0
_IMAGE, _COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_COMPRESSED = f"/{COMPRESSED}"
# The topics for poses of a type that is not expected where it is published.
_PRIORS = {
    "geometry_msgs/msg/PoseStamped": "prior",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "prior_with_covariance",
    "nav_msgs/msg/Odometry": "prior_odometry",
}
_PRIOR_TOPICS = (*_PRIORS.values(), "initialpose")


class GraphWatch:
    """Says why inputs do not come; for the executor's thread.

    Args:
        node: that listens.
        reporter: writes to the log.
    """

    def __init__(self, node: Node, reporter: Reporter) -> None:
        self._node, self._reporter = node, reporter
        self._since = time.monotonic()
        self._said = ""

    def begin(self) -> None:
        """Note that the node begins to listen."""
        self._since, self._said = time.monotonic(), ""

    def look(self, unheard: Sequence[Listener], mode: str) -> str:
        """Return why nothing came on topics, and log it when it changes; empty where there is nothing to say.

        What was said on them before is asked for, where its publisher keeps it.

        Args:
            unheard: the topics on which nothing came yet.
            mode: of the node.
        """
        for listener in unheard:
            listener.hear_latched(self._node)
        problems = [self._problem(listener) for listener in unheard]
        if mode != ON_REQUEST:
            problems += [self._silence(listener) for listener in unheard if listener.topic.needed]
        priors = [listener for listener in unheard if listener.topic.name in _PRIOR_TOPICS]
        if mode == ON_PRIOR and len(priors) == len(_PRIOR_TOPICS):
            names = ", ".join(f"{listener.name} ({listener.type_name})" for listener in priors)
            problems.append(f"no prior yet: publish one on {names}")
        problems = list(filter(None, problems))
        text = "; ".join(problems)
        if text != self._said and time.monotonic() - self._since > _PATIENCE:
            self._said = text
            self._reporter.say(text or "all inputs come now")
        return text

    def _problem(self, listener: Listener) -> str:
        """Return why what is published on a topic does not arrive; empty where nothing is, or it could."""
        publishers = self._node.get_publishers_info_by_topic(listener.name)
        fitting = [publisher for publisher in publishers if publisher.topic_type == listener.type_name]
        if publishers and not fitting:
            found = publishers[0].topic_type
            return f"{listener.name} has {found}, not {listener.type_name}: {_advice(listener, found)}"
        checked = [qos_check_compatible(publisher.qos_profile, listener.qos) for publisher in fitting]
        if checked and all(compatibility == QoSCompatibility.ERROR for compatibility, _ in checked):
            return (
                f"{listener.name} is published with a QoS that does not fit ({checked[0][1].strip(' ;')}): set "
                f"qos_overrides.{listener.name}.subscription.* (ros2 topic info --verbose {listener.name})"
            )
        return ""

    def _silence(self, listener: Listener) -> str:
        """Return what to do where nobody publishes a topic, or one who does sends nothing; empty for other problems."""
        if self._problem(listener):
            return ""
        if self._is_published(listener.name):
            return f"{listener.name} has a publisher, but nothing came from it: is it running?"
        text = f"nobody publishes {listener.name} ({listener.type_name})"
        known = self._node.get_topic_names_and_types()
        there = {name: types for name, types in known if self._is_published(name)}
        others = [name for name, types in there.items() if listener.type_name in types]
        raw, compressed = listener.name.removesuffix(_COMPRESSED), f"{listener.name}{_COMPRESSED}"
        if _COMPRESSED_IMAGE in there.get(compressed, ()):
            return f"{text}, but {compressed} is: set image.transport:=compressed"
        if raw != listener.name and _IMAGE in there.get(raw, ()):
            return f"{text}, but {raw} is: set image.transport:=raw"
        if others:
            return f"{text}; of this type are {', '.join(others)}: remap {listener.topic.name} to the right one"
        return f"{text}: start what does, or remap {listener.topic.name}"

    def _is_published(self, name: str) -> bool:
        """Return whether anybody else publishes a topic."""
        publishers = self._node.get_publishers_info_by_topic(name)
        return any(publisher.node_name != self._node.get_name() for publisher in publishers)


def _advice(listener: Listener, found: str) -> str:
    """Return what to do where messages of another type are published on a topic."""
    name = listener.name
    if (found, listener.type_name) == (_COMPRESSED_IMAGE, _IMAGE):
        remapping = "" if name.endswith(_COMPRESSED) else f", remap {name}{_COMPRESSED}:={name}"
        return f"set image.transport:=compressed{remapping}"
    if (found, listener.type_name) == (_IMAGE, _COMPRESSED_IMAGE):
        return "set image.transport:=raw"
    if listener.type_name in _PRIORS and found in _PRIORS:
        return f"remap {_PRIORS[found]}:={name}"
    return f"publish {listener.type_name}, or remap {listener.topic.name}"
