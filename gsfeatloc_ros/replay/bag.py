"""The messages of a recorded bag that the localizer needs, without ROS."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from backports import zstd
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from gsfeatloc_ros.replay.bag_files import BagError, BagFile, in_words, open_files

_POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_ODOMETRY = "nav_msgs/msg/Odometry"
_TF = "tf2_msgs/msg/TFMessage"
# How a message begins that was compressed by itself; those of ROS 2 begin with a zero.
_ZSTD = b"\x28\xb5\x2f\xfd"
# Of one, unpacked: an image of 50 megapixels of 8 bytes.
_MAX_MESSAGE_BYTES = 400_000_000


class Role(Enum):
    """What a topic is for. The value is what messages to people call it."""

    IMAGE = "image"
    CAMERA_INFO = "camera_info"
    PRIOR = "prior"
    INITIAL_POSE = "initialpose"
    ODOMETRY = "odom"
    TF = "tf"
    TF_STATIC = "tf_static"
    TRUTH = "truth"
    IMU = "imu"


# What messages are taken from the topic of each role.
_TYPES = {
    Role.IMAGE: ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    Role.CAMERA_INFO: ("sensor_msgs/msg/CameraInfo",),
    Role.PRIOR: (*_POSES, _ODOMETRY),
    Role.INITIAL_POSE: ("geometry_msgs/msg/PoseWithCovarianceStamped",),
    Role.ODOMETRY: (_ODOMETRY,),
    Role.TF: (_TF,),
    Role.TF_STATIC: (_TF,),
    Role.TRUTH: (*_POSES, _ODOMETRY),
    Role.IMU: ("sensor_msgs/msg/Imu",),
}
# Taken if they are there: a bag need not have them.
_OPTIONAL = (Role.TF, Role.TF_STATIC)


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
        start: time of its first message, in nanoseconds.
        seconds: from its first to its last message.
    """

    path: Path
    storage: StoragePlugin
    images: int
    start: int
    seconds: float
    _files: Sequence[BagFile]
    _roles: dict[str, list[Role]]
    _types: Typestore

    def messages(self) -> Iterator[Recorded]:
        """Yield the messages of all roles in the order in which they were recorded.

        Raises:
            BagError: the bag is damaged from here on.
        """
        for file in self._files:
            recorded = file.messages(self._roles)
            while True:
                try:
                    channel, bag_time, cdr = next(recorded)
                except StopIteration:
                    break
                except Exception as error:  # the libraries pass on whatever the decompressor, the database ... raise
                    raise BagError(f"{self.path}: is damaged, and ends here: {in_words(error)}") from error
                message, problem = None, ""
                try:
                    cdr = _unpacked(cdr) if cdr.startswith(_ZSTD) else cdr
                    message = self._types.deserialize_cdr(cdr, channel.type)
                except Exception as error:  # the same
                    problem = f"the bytes of this message are no {channel.type}: {in_words(error)}"
                for role in self._roles[channel.topic]:
                    yield Recorded(role, bag_time, message, problem)


@contextmanager
def open_bag(path: Path, topics: Mapping[Role, Sequence[str]]) -> Iterator[Bag]:
    """Open a rosbag2 (a folder, or one .mcap or .db3 file) and check that it has what is needed.

    What else is in it does not matter. Messages are read with the types of ROS 2 Jazzy.

    Args:
        path: of the bag.
        topics: those of each role that is wanted; those of tf need not be there.

    Raises:
        BagError: the bag cannot be read, has no such topic, or messages of another type on it; or it has no images,
            where these are wanted.
    """
    if not path.exists():
        raise BagError(f"{path}: there is no such bag")
    with ExitStack() as stack:
        files = open_files(path, stack)
        roles: dict[str, list[Role]] = {}
        for role, names in topics.items():
            for topic in names:
                if _is_there(path, files, role, topic):
                    roles.setdefault(topic, []).append(role)
        wanted = topics.get(Role.IMAGE, ())
        images = sum(count for file in files for channel, count in file.counts.items() if channel.topic in wanted)
        if wanted and not images:
            raise BagError(f"{path}: has no message on {_either(wanted)}")
        times = [time for file in files if file.times for time in file.times] or [0]
        start, seconds = min(times), 1e-9 * (max(times) - min(times))
        types = get_typestore(Stores.ROS2_JAZZY)
        yield Bag(path, files[0].storage, images, start, seconds, files, roles, types)


def _unpacked(compressed: bytes) -> bytes:
    """Return the bytes of a message that was compressed by itself; raise ValueError or ZstdError where that fails."""
    decompressor = zstd.ZstdDecompressor()
    cdr = decompressor.decompress(compressed, _MAX_MESSAGE_BYTES)
    if not decompressor.eof:
        raise ValueError(f"it was cut short, or unpacks to more than {_MAX_MESSAGE_BYTES // 10**6} megabytes")
    return bytes(cdr)


def _is_there(path: Path, files: Sequence[BagFile], role: Role, topic: str) -> bool:
    """Return whether a bag has a topic that can be used; raise BagError where it must and does not."""
    channels = {channel for file in files for channel in file.counts}
    found = {channel for channel in channels if channel.topic == topic}
    if not found and role in _OPTIONAL:
        return False
    if not found:
        there = sorted({f"{channel.topic} ({channel.type})" for channel in channels})
        raise BagError(f"{path}: has no topic {topic}; it has {', '.join(there) or 'none: it is empty'}")
    if wrong := sorted({channel.type for channel in found} - set(_TYPES[role])):
        raise BagError(f"{path}: {topic} has {_either(wrong)}; {role.value} must be {_either(_TYPES[role])}")
    if wrong := sorted({channel.encoding for channel in found} - {"cdr"}):
        raise BagError(f"{path}: {topic} is encoded as {_either(wrong)}: only ROS 2's own cdr is read")
    return True


def _either(kinds: Sequence[str]) -> str:
    return " or ".join(kinds)
