"""Where the camera was in the robot's frame, by a bag's odometry or tf."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsfeatloc_ros.replay.bag import Bag, Role, open_bag
from gsfeatloc_ros.replay.bag_files import BagError
from gsfeatloc_ros.ros_io.decode import decode_pose, frame_name, nanoseconds
from gsfeatloc_ros.ros_io.message_types import TransformStamped
from gsfeatloc_ros.ros_io.prior import body_of
from gsfeatloc_ros.ros_io.transform_tree import TransformError, TransformTree

TF_TOPICS = {Role.TF: ["/tf"], Role.TF_STATIC: ["/tf_static"]}
# Nanoseconds of tf for which a transform of before is waited for.
_MAX_WAIT = 1_000_000_000


@dataclass(frozen=True, eq=False)
class RobotPath:
    """What a bag says of where the camera was.

    Attributes:
        bag: rosbag2.
        odometry: topic of nav_msgs/Odometry; empty to take tf.
        frame: robot's frame, to look the camera up in by tf.
        camera_frame: name of the camera's optical frame; empty for that of the images on `image`.
        image: topic of images; may be empty where the camera's frame is named or not needed.
        T_body_camera: (4, 4) in the odometry's body or, by tf, in `camera_frame`; None to ask tf.
    """

    bag: Path
    odometry: str = ""
    frame: str = "odom"
    camera_frame: str = ""
    image: str = ""
    T_body_camera: np.ndarray | None = None

    def read(self, stamps: Sequence[int]) -> list[tuple[int, np.ndarray]]:
        """Return stamps in nanoseconds and T_robot_camera (4, 4): of all odometry, or by tf at `stamps`.

        Raises:
            BagError: the bag cannot be read, or lacks what is needed; the message says what.
            ValueError: odometry that cannot be used.
        """
        poses, body = self._of_odometry() if self.odometry else (self._of_tf(stamps), "")
        if not poses:
            there = f"no odometry on {self.odometry}" if self.odometry else f"tf to {self.frame} at no photo's time"
            raise BagError(f"{self.bag}: has {there}")
        if body:
            T_body_camera = self.mounted(body)
            return [(stamp, pose @ T_body_camera) for stamp, pose in poses]
        return poses

    def _of_odometry(self) -> tuple[list[tuple[int, np.ndarray]], str]:
        """Return T_odom_body by stamps, and the name of the body."""
        poses, bodies = [], set()
        with open_bag(self.bag, {Role.ODOMETRY: [self.odometry]}) as bag:
            for recorded in bag.messages():
                if recorded.message is None:
                    raise BagError(f"{self.bag}: {self.odometry}: {recorded.problem}")
                bodies.add(body_of(recorded.message, self.odometry))
                poses.append((nanoseconds(recorded.message.header.stamp), decode_pose(recorded.message, self.odometry)))
        if len(bodies) > 1:
            raise BagError(f"{self.bag}: {self.odometry} is of {' and of '.join(sorted(bodies))}")
        return poses, "".join(bodies)

    def mounted(self, body: str) -> np.ndarray:
        """Return T_body_camera (4, 4), of a camera that does not move on the robot."""
        if self.T_body_camera is not None:
            return self.T_body_camera
        tree = TransformTree()
        with open_bag(self.bag, TF_TOPICS) as bag:
            for _ in transforms(bag, tree):
                pass
        try:
            return tree.lookup(body, self.camera(), 0)
        except TransformError as error:
            raise BagError(f"{self.bag}: {error}, or give --extrinsics") from error

    def _of_tf(self, stamps: Sequence[int]) -> list[tuple[int, np.ndarray]]:
        found, tree, waiting = [], TransformTree(), sorted(set(stamps))
        camera, mounted = self.camera(), np.eye(4) if self.T_body_camera is None else self.T_body_camera
        with open_bag(self.bag, TF_TOPICS) as bag:
            for transform in transforms(bag, tree):
                now = nanoseconds(transform.header.stamp)
                while waiting and waiting[0] <= now:
                    try:
                        found.append((waiting[0], tree.lookup(self.frame, camera, waiting[0]) @ mounted))
                    except TransformError:
                        if now < waiting[0] + _MAX_WAIT:
                            break
                    del waiting[0]
        return found

    def camera(self) -> str:
        """Return the name of the camera's frame; raise BagError where nothing says it."""
        if self.camera_frame or not self.image:
            if not self.camera_frame:
                raise BagError(f"{self.bag}: what is the camera's frame? Name it (--camera-frame) or its --image")
            return self.camera_frame
        with open_bag(self.bag, {Role.IMAGE: [self.image]}) as bag:
            for recorded in bag.messages():
                if recorded.message is not None:
                    return frame_name(recorded.message.header.frame_id)
        raise BagError(f"{self.bag}: no image on {self.image} can be read")


def transforms(bag: Bag, tree: TransformTree) -> Iterator[TransformStamped]:
    """Yield the transforms of a bag, in order, each after `tree` took it."""
    for recorded in bag.messages():
        if recorded.message is not None and recorded.role in TF_TOPICS:
            for transform in recorded.message.transforms:
                tree.take(transform, static=recorded.role is Role.TF_STATIC)
                yield transform
