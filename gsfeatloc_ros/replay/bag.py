"""The messages of a recorded bag that the localizer needs, without ROS."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

_POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")


class Role(Enum):
    """What a topic is for. The value is what messages to people call it."""

    IMAGE = "image"
    CAMERA_INFO = "camera_info"
    PRIOR = "prior"
    TRUTH = "truth"


# What messages are taken from the topic of each role.
_TYPES = {
    Role.IMAGE: ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    Role.CAMERA_INFO: ("sensor_msgs/msg/CameraInfo",),
    Role.PRIOR: _POSES,
    Role.TRUTH: (*_POSES, "nav_msgs/msg/Odometry"),
}


class BagError(ValueError):
    """A bag cannot be read, or lacks what is asked of it; the message names it and says what to do."""


@dataclass(frozen=True)
class Recorded:
    """A message as it was recorded.

    Attributes:
        role: what it is for.
        bag_time: when it was recorded, in nanoseconds.
        message: with the fields of its type; None if its bytes are not those of such a message.
        problem: why it is None.
    """

    role: Role
    bag_time: int
    message: Any
    problem: str = ""


@dataclass(frozen=True, eq=False)
class Bag:
    """An open bag.

    Attributes:
        path: as it was opened.
        storage: how its messages are stored.
        images: number of its images.
        seconds: from its first to its last message.
    """

    path: Path
    storage: StoragePlugin
    images: int
    seconds: float
    _reader: AnyReader
    _roles: dict[str, list[Role]]

    def messages(self) -> Iterator[Recorded]:
        """Yield the messages of all roles in the order in which they were recorded.

        Raises:
            BagError: the bag is damaged from here on.
        """
        wanted = [connection for connection in self._reader.connections if connection.topic in self._roles]
        recorded = self._reader.messages(wanted)
        while True:
            try:
                connection, bag_time, cdr = next(recorded)
            except StopIteration:
                return
            except Exception as error:  # rosbags passes on whatever the decompressor, the database ... raise
                raise BagError(f"{self.path}: is damaged, and ends here: {_words(error)}") from error
            message, problem = None, ""
            try:
                message = self._reader.deserialize(cdr, connection.msgtype)
            except Exception as error:  # the same
                problem = f"the bytes of this message are no {connection.msgtype}: {_words(error)}"
            for role in self._roles[connection.topic]:
                yield Recorded(role, bag_time, message, problem)


@contextmanager
def open_bag(path: Path, topics: Mapping[Role, str]) -> Iterator[Bag]:
    """Open a rosbag2 (a folder, or one .mcap or .db3 file) and check that it has what is needed.

    Args:
        path: of the bag.
        topics: topic of each role that is wanted, the images' among them.

    Raises:
        BagError: the bag cannot be read, has no such topic, or messages of another type on it; or it has no images.
    """
    if not path.exists():
        raise BagError(f"{path}: there is no such bag")
    if path.suffix == ".bag":
        raise BagError(f"{path}: is a bag of ROS 1: convert it with rosbags-convert")
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    except Exception as error:  # rosbags passes on whatever the database, the YAML parser ... raise
        raise BagError(
            f"{path}: cannot be read: {_words(error)}; was its recording cut short? Try ros2 bag reindex"
        ) from error
    try:
        roles: dict[str, list[Role]] = {}
        for role, topic in topics.items():
            _check_topic(path, reader, role, topic)
            roles.setdefault(topic, []).append(role)
        images = sum(connection.msgcount for connection in reader.connections if connection.topic == topics[Role.IMAGE])
        if not images:
            raise BagError(f"{path}: has no message on {topics[Role.IMAGE]}")
        yield Bag(path, _storage(path), images, 1e-9 * reader.duration, reader, roles)
    finally:
        reader.close()


def _check_topic(path: Path, reader: AnyReader, role: Role, topic: str) -> None:
    found = {connection.msgtype for connection in reader.connections if connection.topic == topic}
    if not found:
        there = sorted({f"{connection.topic} ({connection.msgtype})" for connection in reader.connections})
        raise BagError(f"{path}: has no topic {topic}; it has {', '.join(there) or 'none: it is empty'}")
    if wrong := sorted(found.difference(_TYPES[role])):
        raise BagError(f"{path}: {topic} has {_either(wrong)}; {role.value} must be {_either(_TYPES[role])}")


def _storage(path: Path) -> StoragePlugin:
    files = path.iterdir() if path.is_dir() else [path]
    return StoragePlugin.MCAP if any(".mcap" in file.suffixes for file in files) else StoragePlugin.SQLITE3


def _either(kinds: Sequence[str]) -> str:
    return " or ".join(kinds)


def _words(error: Exception) -> str:
    """Return what an error says, in one line; some say nothing, then its type."""
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__
