"""What an image is localized with: its camera, and the prior at its time. One policy for the node and for replay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock
from typing import Any, Generic, TypeVar

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, rotate_covariance, shift_covariance
from gsfeatloc_ros.ros_io.decode import (
    decode_camera,
    decode_covariance,
    decode_picture,
    decode_pose,
    nanoseconds,
    picture_size,
)
from gsfeatloc_ros.ros_io.odometry import Odometry

T = TypeVar("T")

# T_target_source (4, 4) of two frames at a stamp in nanoseconds; raises ValueError where it is not known.
Lookup = Callable[[str, str, int], np.ndarray]

# Images may come later than the odometry of their time by this many seconds.
_LAG = 5.0


@dataclass(frozen=True)
class PriorPolicy:
    """What a rough pose is worth.

    Attributes:
        map_frame: name of the map's frame.
        base_frame: name of the robot base's frame.
        of_base: whether priors are poses of the base; otherwise of the camera's optical frame.
        max_age: seconds by which a rough pose may be older or newer than the image if no odometry carries it to the
            image's time; 0 for no limit.
        odometry_max_age: seconds over which odometry may carry it.
    """

    map_frame: str = "map"
    base_frame: str = "base_link"
    of_base: bool = False
    max_age: float = 10.0
    odometry_max_age: float = 60.0


@dataclass(frozen=True, eq=False)
class RoughPose:
    """Where the camera or the base was, roughly, as it came.

    Attributes:
        name: what it is called: "prior", "initialpose", "last answer".
        stamp: in nanoseconds; 0 for none, then it holds at any time.
        frame: that it is given in.
        of_base: whether it is the pose of the base; otherwise of the camera's optical frame.
        pose: (4, 4) in `frame`.
        covariance: (6, 6) about the axes of `frame` in ROS order, or None where it is not known.
    """

    name: str
    stamp: int
    frame: str
    of_base: bool
    pose: np.ndarray
    covariance: np.ndarray | None


@dataclass(frozen=True, eq=False)
class Query:
    """All that Localizer.localize wants to know.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        camera: of the image.
        T_map_camera_prior: (4, 4).
        prior_covariance: (6, 6) in ROS order about the map's axes, or None where it is not known.
        rough: what the prior was made of.
    """

    image: np.ndarray
    camera: Camera
    T_map_camera_prior: np.ndarray
    prior_covariance: np.ndarray | None
    rough: RoughPose


@dataclass(frozen=True)
class Newest(Generic[T]):
    """What the newest message of a topic holds, or why there is nothing to use.

    A message that cannot be used takes the place of an older good one: what is old is not passed off as new.
    """

    value: T | None = None
    problem: str = ""

    def get(self) -> T:
        """The value; raises ValueError with the problem where there is none."""
        if self.value is None:
            raise ValueError(self.problem)
        return self.value


class Inputs:
    """The newest camera_info, rough pose and odometry, and what follows from them for an image.

    A rough pose is one that came from outside, or the last answer (`take_answer`); the newest of either counts.
    Messages may be taken in one thread and images asked for in another.

    Args:
        policy: what a rough pose is worth; may be replaced later.
        lookup: of the robot's frames.
        rectified: whether images are.
        no_camera, no_prior: what to say while there is none.
    """

    def __init__(self, policy: PriorPolicy, lookup: Lookup, rectified: bool, no_camera: str, no_prior: str) -> None:
        self.policy = policy
        self._lookup = lookup
        self._rectified = rectified
        self._no_prior = no_prior
        self._camera: Newest[Camera] = Newest(problem=no_camera)
        self._rough: Newest[RoughPose] = Newest(problem=no_prior)
        self._rough_lock = Lock()
        self._odometry = Odometry(policy.odometry_max_age + _LAG)
        self._odometry_frame = ""

    @property
    def missing(self) -> list[str]:
        """Why no image can be localized now; empty if one can."""
        return [newest.problem for newest in (self._camera, self._rough) if newest.value is None]

    def take_camera_info(self, message: Any) -> None:
        """Take a CameraInfo; raises ValueError if it cannot be used: `lose` it then."""
        self._camera = Newest(decode_camera(message, self._rectified))

    def take_prior(self, message: Any, name: str = "prior") -> None:
        """Take a PoseStamped or a PoseWithCovarianceStamped; raises ValueError if it cannot be used: `lose` it then.

        Args:
            message: the rough pose.
            name: "initialpose" for one of RViz, which is of the base in any case; "prior" for others.
        """
        rough = self.rough_pose(message, name)
        with self._rough_lock:
            self._rough = Newest(rough)

    def lose(self, topic: str, problem: str) -> None:
        """The newest message of a topic cannot be used; it takes the place of an older good one all the same."""
        if topic == "camera_info":
            self._camera = Newest(problem=problem)
        elif topic in ("prior", "initialpose"):
            with self._rough_lock:
                self._rough = Newest(problem=problem)

    def take_odometry(self, message: Any) -> None:
        """Take an Odometry; raises ValueError if it cannot be used."""
        pose = decode_pose(message, "odom")
        if message.child_frame_id != self._odometry_frame:
            self._odometry = Odometry(self.policy.odometry_max_age + _LAG)
            self._odometry_frame = message.child_frame_id
        self._odometry.add(nanoseconds(message.header.stamp), pose)

    def take_answer(self, T_map_camera: np.ndarray, stamp: int, started_from: RoughPose) -> None:
        """Go on from the answer (4, 4) of the image of `stamp`, unless a prior came since the one it started from."""
        answer = RoughPose("last answer", stamp, self.policy.map_frame, False, T_map_camera, None)
        with self._rough_lock:
            if self._rough.value is started_from:
                self._rough = Newest(answer)

    def forget_after(self, stamp: int) -> None:
        """Forget what is stamped later than `stamp` (nanoseconds): time went back."""
        self._odometry.forget_after(stamp)
        with self._rough_lock:
            if self._rough.value and self._rough.value.stamp > stamp:
                self._rough = Newest(problem=f"time went back: {self._no_prior}")

    def forget_answer(self) -> None:
        """Do not go on from the last answer: it is of another map."""
        with self._rough_lock:
            if self._rough.value and self._rough.value.name == "last answer":
                self._rough = Newest(problem=self._no_prior)

    def rough_pose(self, message: Any, name: str = "prior") -> RoughPose:
        """What a PoseStamped or a PoseWithCovarianceStamped says; raises ValueError if it cannot be used."""
        if not message.header.frame_id:
            raise ValueError(f"{name} is in frame '': name the frame in its header, the map's or one that tf knows")
        return RoughPose(
            name,
            nanoseconds(message.header.stamp),
            message.header.frame_id,
            self.policy.of_base or name == "initialpose",
            decode_pose(message, name),
            decode_covariance(message, name),
        )

    def query(self, message: Any, camera: Camera | None = None, rough: RoughPose | None = None) -> Query:
        """What to localize the image in an Image or CompressedImage with.

        Args:
            message: the image.
            camera: of the image; None for that of the newest camera_info.
            rough: where it was taken; None for the newest.

        Raises:
            ValueError: the image cannot be decoded, something is missing, of another size, too old, or in a frame from
                which no way is known.
        """
        camera, rough = camera or self._camera.get(), rough or self._rough.get()
        width, height = picture_size(message)
        if (camera.width, camera.height) != (width, height):
            raise ValueError(
                f"camera_info is for {camera.width}x{camera.height} but the image is {width}x{height}: use the "
                "camera_info of this image"
            )
        pose, covariance = self._at(rough, nanoseconds(message.header.stamp), message.header.frame_id)
        return Query(decode_picture(message), camera, pose, covariance, rough)

    def _at(self, rough: RoughPose, stamp: int, camera_frame: str) -> tuple[np.ndarray, np.ndarray | None]:
        """Pose (4, 4) and covariance (6, 6) of the camera in the map frame at `stamp`, as far as `rough` says."""
        policy, pose, covariance = self.policy, rough.pose, rough.covariance
        if rough.frame != policy.map_frame:
            try:
                T_map_frame = self._lookup(policy.map_frame, rough.frame, rough.stamp)
            except ValueError as error:
                raise ValueError(
                    f"{rough.name} is in frame {rough.frame!r} but the map is in {policy.map_frame!r}: {error}"
                ) from error
            pose = T_map_frame @ pose
            covariance = None if covariance is None else rotate_covariance(covariance, T_map_frame[:3, :3])
        if rough.of_base:
            base = pose
            pose = base @ self._lookup(policy.base_frame, camera_frame, stamp)
            covariance = None if covariance is None else shift_covariance(covariance, pose[:3, 3] - base[:3, 3])
        if not stamp or not rough.stamp:
            return pose, covariance
        age = 1e-9 * (stamp - rough.stamp)
        motion = self._odometry.motion(rough.stamp, stamp) if abs(age) <= policy.odometry_max_age else None
        if motion is not None:
            T_body_camera = self._lookup(self._odometry_frame, camera_frame, stamp)
            return pose @ invert(T_body_camera) @ motion @ T_body_camera, covariance
        if policy.max_age and abs(age) > policy.max_age:
            advice = "send a newer one" if age > 0 else "do the clocks that stamp them agree (use_sim_time)?"
            raise ValueError(
                f"{rough.name} is {abs(age):.1f} s {'older' if age > 0 else 'newer'} than the image (at most "
                f"{policy.max_age:g}, prior_max_age): {advice}"
            )
        return pose, covariance
