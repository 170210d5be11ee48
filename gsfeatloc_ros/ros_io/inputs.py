"""What an image is localized with: its camera, and the prior at its time. One policy for the node and for replay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from threading import Lock
from typing import Any, Generic, TypeVar

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, isotropic_covariance, rotate_covariance, shift_covariance
from gsfeatloc_ros.ros_io.calibration import decode_camera
from gsfeatloc_ros.ros_io.compressed_image import PictureError
from gsfeatloc_ros.ros_io.decode import decode_pose, frame_name, nanoseconds
from gsfeatloc_ros.ros_io.growth import Growth, Travelled, position_sigma
from gsfeatloc_ros.ros_io.message_types import AnyImage
from gsfeatloc_ros.ros_io.message_types import Odometry as OdometryMessage
from gsfeatloc_ros.ros_io.odometry import OdometryBuffer, Way
from gsfeatloc_ros.ros_io.pictures import PictureReader
from gsfeatloc_ros.ros_io.prior import Prior, PriorPolicy, PriorSource, body_of, decode_prior

T = TypeVar("T")

# T_target_source (4, 4) of two frames at a stamp in nanoseconds; raises ValueError where it is not known.
Lookup = Callable[[str, str, int], np.ndarray]

# Seconds. Images may come later than the odometry of their time by this much.
_MAX_IMAGE_DELAY = 5.0
# What is gone on from, and how far off (6, 6) that usually is to begin with: map units and radians.
_ANSWERS = (PriorSource.LAST_ANSWER, PriorSource.UNCONFIRMED)
_OF_ANSWERS = isotropic_covariance(0.003, np.radians(0.05))


class InputTopic(Enum):
    """What messages come on. The value is what messages to people call it."""

    CAMERA_INFO = "camera_info"
    PRIOR = "prior"
    INITIAL_POSE = "initialpose"
    ODOMETRY = "odom"


@dataclass(frozen=True, eq=False)
class LocalizerInput:
    """All that Localizer.localize takes.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        camera: of the image, with its motion while the rows were read, where that is known.
        T_map_camera_prior: (4, 4); None where nothing is known.
        prior_covariance: (6, 6) in ROS order about the map's axes, or None where it is not known.
        prior: what the two were made of, if anything.
        newest_prior: the newest that came from outside or was an answer, used or not.
        usual_covariance: (6, 6) of how far off the prior usually is, where prior_covariance allows for more; else None.
    """

    image: np.ndarray
    camera: Camera
    T_map_camera_prior: np.ndarray | None
    prior_covariance: np.ndarray | None
    prior: Prior | None
    newest_prior: Prior | None
    usual_covariance: np.ndarray | None

    @property
    def source(self) -> PriorSource | None:
        """Where the prior comes from; None where there is none."""
        return None if self.prior is None else self.prior.source


@dataclass(frozen=True)
class _Newest(Generic[T]):
    """What the newest message of a topic holds, or why there is nothing to use.

    A message that cannot be used takes the place of an older good one: what is old is not passed off as new.
    """

    value: T | None = None
    problem: str = ""

    def get(self) -> T:
        """Return the value; raise ValueError with the problem where there is none."""
        if self.value is None:
            raise ValueError(self.problem)
        return self.value


# No prior came: that is no problem.
_NOTHING: _Newest[Prior] = _Newest()


@dataclass(frozen=True, eq=False)
class NewestInputs:
    """The newest camera_info and prior of a moment, or why they cannot be used.

    Attributes:
        camera, prior: see there.
        forgotten: how often something was forgotten up to then: what was forgotten since does not count.
    """

    camera: _Newest[Camera]
    prior: _Newest[Prior]
    forgotten: int = 0

    def without_prior(self) -> NewestInputs:
        """Return the same camera, and nothing of where it is."""
        return replace(self, prior=_NOTHING)


class Inputs:
    """The newest camera_info, prior and odometry, and what follows from them for an image.

    A prior is one that came from outside, or the last answer (`take_answer`); the newest of either counts. Without any,
    an image may be anywhere in the map, or, of a planar robot, anywhere on its plane. Messages may be taken in one
    thread and images asked for in another.

    Args:
        policy: what priors are worth.
        lookup: of the robot's frames.
        rectified: whether images are.
        no_camera: what to say while there is no camera_info.
        pictures: decodes the images.

    Attributes:
        policy: what priors are worth; may be replaced later.
        line_delay: seconds from a row of images to the next; 0 for a global shutter. May be replaced later.
    """

    def __init__(
        self,
        policy: PriorPolicy,
        lookup: Lookup,
        rectified: bool,
        no_camera: str,
        pictures: PictureReader | None = None,
    ) -> None:
        self.policy = policy
        self.line_delay = 0.0
        self._lookup = lookup
        self._rectified = rectified
        self._pictures = pictures or PictureReader()
        self._camera: _Newest[Camera] = _Newest(problem=no_camera)
        self._prior: _Newest[Prior] = _NOTHING
        self._prior_lock = Lock()
        self._forgotten = 0
        self._odometry = self._no_odometry()
        # Of the odometry itself, and of the body whose poses it gives.
        self._odometry_frames = ("", "")

    @property
    def missing(self) -> list[str]:
        """Why no image can be localized now; empty if one can."""
        return [newest.problem for newest in (self._camera, self._prior) if newest.problem]

    def newest(self) -> NewestInputs:
        """Return what an image of this moment is localized with, whatever comes later."""
        return NewestInputs(self._camera, self._prior, self._forgotten)

    def take(self, topic: InputTopic, message: Any) -> None:
        """Take the newest message of a topic; one that cannot be used takes the place of an older good one.

        Args:
            topic: that it came on.
            message: CameraInfo; of priors PoseStamped, PoseWithCovarianceStamped or Odometry; or Odometry.

        Raises:
            ValueError: the message cannot be used; the error says why.
        """
        try:
            if topic is InputTopic.CAMERA_INFO:
                self._camera = _Newest(decode_camera(message, self._rectified))
            elif topic is InputTopic.PRIOR:
                self._set_prior(_Newest(decode_prior(message, PriorSource.PRIOR, self.policy)))
            elif topic is InputTopic.INITIAL_POSE:
                self._set_prior(_Newest(decode_prior(message, PriorSource.INITIAL_POSE, self.policy)))
            else:
                self._take_odometry(message)
        except ValueError as error:
            self.invalidate(topic, str(error))
            raise

    def invalidate(self, topic: InputTopic, problem: str) -> None:
        """Forget the older message of a topic, for its newest cannot be used; older odometry still counts."""
        if topic is InputTopic.CAMERA_INFO:
            self._camera = _Newest(problem=problem)
        elif topic in (InputTopic.PRIOR, InputTopic.INITIAL_POSE):
            self._set_prior(_Newest(problem=problem))

    def take_answer(self, answer: Prior, started_from: LocalizerInput) -> None:
        """Go on from an answer, unless a prior came since the one it started from.

        Args:
            answer: as a prior.
            started_from: what its image was localized with.
        """
        with self._prior_lock:
            if self._prior.value is started_from.newest_prior and not self._prior.problem:
                self._prior = _Newest(answer)

    def forget_after(self, stamp: int) -> None:
        """Forget what is stamped later than `stamp` (nanoseconds): time went back."""
        self._forgotten += 1
        self._odometry.forget_after(stamp)
        with self._prior_lock:
            if self._prior.value and self._prior.value.stamp > stamp:
                self._prior = _NOTHING

    def forget_answer(self) -> None:
        """Do not go on from the last answer: it is of another map, or worth nothing any more."""
        self._forgotten += 1
        with self._prior_lock:
            if self._prior.value and self._prior.value.source.own:
                self._prior = _NOTHING

    def forget_prior(self) -> None:
        """Forget all that is known of where the robot is."""
        self._forgotten += 1
        self._set_prior(_NOTHING)

    def start_from(self, saved: Prior) -> None:
        """Look first near a pose of a run before, until a prior comes."""
        with self._prior_lock:
            if self._prior is _NOTHING:
                self._prior = _Newest(saved)

    @property
    def odometry(self) -> OdometryBuffer:
        """The newest odometry."""
        return self._odometry

    @property
    def odometry_body(self) -> str:
        """Frame of the body whose poses odometry gives; empty where none came."""
        return self._odometry_frames[1]

    def camera_on_body(self, camera_frame: str, stamp: int) -> np.ndarray:
        """Return T_body_camera (4, 4) on that body at `stamp` (nanoseconds); raise ValueError where it is not known."""
        return self._transform(self.odometry_body, camera_frame, stamp)

    def has_odometry(self, stamp: int) -> bool:
        """Return whether odometry says where the robot was at `stamp` (nanoseconds)."""
        return self._odometry.between(stamp, stamp) is not None

    def travelled(self, start: int, end: int) -> Travelled | None:
        """Return how far the robot went between two times (nanoseconds); None where odometry does not tell."""
        way = self._odometry.between(start, end)
        return None if way is None else way.travelled

    def carried_sigma(self) -> float | None:
        """Return the standard deviation of the last answer's position as odometry has carried it up to now.

        None where no answer counts, or no odometry carries it.
        """
        prior, newest = self._prior.value, self._odometry.newest
        if prior is None or not prior.source.own or not prior.stamp or newest is None:
            return None
        travelled = self.travelled(prior.stamp, newest)
        return (
            None
            if travelled is None
            else position_sigma(self._grown(prior.covariance, self.policy.growth.by_odometry(travelled)))
        )

    def for_image(
        self,
        message: AnyImage,
        camera: Camera | None = None,
        prior: Prior | None = None,
        inputs: NewestInputs | None = None,
    ) -> LocalizerInput:
        """Return what to localize an image with.

        Args:
            message: the image.
            camera: of the image; None for that of the newest camera_info.
            prior: where it was taken; None for the newest, if there is one.
            inputs: the newest camera_info and prior; None for those of now.

        Raises:
            PictureError: the image cannot be decoded, or is of another size than its camera's.
            ValueError: something is missing, of the future, or in a frame from which no way is known.
        """
        inputs = inputs or self.newest()
        camera = camera or inputs.camera.get()
        newest = inputs.prior
        if inputs.forgotten != self._forgotten and (
            self._prior is _NOTHING or (newest.value and newest.value.source.own)
        ):
            newest = _NOTHING
        if prior is None and newest.problem:
            raise ValueError(newest.problem)
        prior = prior or newest.value or (self.policy.plane() if self.policy.planar else None)
        picture = self._pictures.open(message)
        if (camera.width, camera.height) != (picture.width, picture.height):
            raise PictureError(
                f"camera_info is for {camera.width}x{camera.height} but the image is {picture.width}x{picture.height}: "
                "use the camera_info of this image"
            )
        stamp, frame = nanoseconds(message.header.stamp), frame_name(message.header.frame_id)
        pose, covariance = (None, None) if prior is None else self._at(prior, stamp, frame)
        usual = None if prior is None else self._usual_covariance(prior, stamp)
        camera = replace(camera, readout=self._readout(stamp, frame, picture.height))
        return LocalizerInput(picture.decode(), camera, pose, covariance, prior, newest.value, usual)

    def _set_prior(self, newest: _Newest[Prior]) -> None:
        with self._prior_lock:
            self._prior = newest

    def _no_odometry(self) -> OdometryBuffer:
        return OdometryBuffer(self.policy.odometry_max_age + _MAX_IMAGE_DELAY)

    def _take_odometry(self, message: OdometryMessage) -> None:
        pose = decode_pose(message, InputTopic.ODOMETRY.value)
        frames = (frame_name(message.header.frame_id), body_of(message, InputTopic.ODOMETRY.value))
        if frames != self._odometry_frames:
            self._odometry = self._no_odometry()
            self._odometry_frames = frames
        self._odometry.add(nanoseconds(message.header.stamp), pose)

    def _readout(self, stamp: int, camera_frame: str, rows: int) -> np.ndarray | None:
        """Return how the camera moved (6,) while it read the rows of an image; None where that is not known."""
        velocity = self._odometry.velocity(stamp) if stamp and self.line_delay else None
        if velocity is None:
            return None
        T_body_camera = self.camera_on_body(camera_frame, stamp)
        linear, angular = velocity[:3] + np.cross(velocity[3:], T_body_camera[:3, 3]), velocity[3:]
        in_camera = np.concatenate([linear @ T_body_camera[:3, :3], angular @ T_body_camera[:3, :3]])
        return rows * self.line_delay * in_camera

    def _at(self, prior: Prior, stamp: int, camera_frame: str) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the pose (4, 4) and covariance (6, 6) of the camera in the map frame at `stamp` by a prior."""
        policy, pose, covariance = self.policy, prior.pose, prior.covariance
        if prior.frame != policy.map_frame:
            try:
                T_map_frame = self._transform(policy.map_frame, prior.frame, prior.stamp)
            except ValueError as error:
                raise ValueError(
                    f"{prior.source.value} is in frame {prior.frame!r} but the map is in {policy.map_frame!r}: {error}"
                ) from error
            pose = T_map_frame @ pose
            covariance = None if covariance is None else rotate_covariance(covariance, T_map_frame[:3, :3])
        if prior.body:
            body = pose
            pose = body @ self._transform(prior.body, camera_frame, stamp)
            covariance = None if covariance is None else shift_covariance(covariance, pose[:3, 3] - body[:3, 3])
        if not stamp or not prior.stamp:
            return pose, covariance
        age = 1e-9 * (stamp - prior.stamp)
        way = self._way(prior, stamp)
        if way is not None:
            T_body_camera = self.camera_on_body(camera_frame, stamp)
            pose = pose @ invert(T_body_camera) @ way.motion @ T_body_camera
            return pose, self._grown(covariance, policy.growth.by_odometry(way.travelled))
        if not prior.source.own and policy.max_age and -age > policy.max_age:
            raise ValueError(
                f"{prior.source.value} is {-age:.1f} s newer than the image (at most {policy.max_age:g}, "
                "prior_max_age): do the clocks that stamp them agree (use_sim_time)?"
            )
        if prior.source.own or (policy.max_age and age > policy.max_age):
            covariance = self._grown(covariance, policy.growth.by_time(age))
        return pose, covariance

    def _usual_covariance(self, prior: Prior, stamp: int) -> np.ndarray | None:
        """Return how far off (6, 6) an answer usually is at `stamp`, when it was right; None for other priors."""
        if not (prior.source in _ANSWERS and stamp and prior.stamp):
            return None
        way, growth = self._way(prior, stamp), self.policy.growth
        grown = growth.by_time(1e-9 * (stamp - prior.stamp)) if way is None else growth.by_odometry(way.travelled)
        return grown.added_to(_OF_ANSWERS, self.policy.planar)

    def _way(self, prior: Prior, stamp: int) -> Way | None:
        """Return how the robot went from a prior's time to `stamp`; None where odometry does not carry it there."""
        age = 1e-9 * abs(stamp - prior.stamp)
        return self._odometry.between(prior.stamp, stamp) if age <= self.policy.odometry_max_age else None

    def _transform(self, target: str, source: str, stamp: int) -> np.ndarray:
        return np.eye(4) if target == source else self._lookup(target, source, stamp)

    def _grown(self, covariance: np.ndarray | None, growth: Growth) -> np.ndarray:
        known = self.policy.default_covariance() if covariance is None else covariance
        return growth.added_to(known, self.policy.planar)
