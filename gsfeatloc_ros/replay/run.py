"""The localizer on a recorded bag: as the node, but without ROS, and with every image."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.localize.engine import Engine
from gsfeatloc_ros.replay.bag import Bag, BagError, Recorded, Role
from gsfeatloc_ros.ros_io.decode import decode_pose, frame_name, nanoseconds
from gsfeatloc_ros.ros_io.follower import Follower
from gsfeatloc_ros.ros_io.inputs import Inputs, InputTopic, LocalizerInput
from gsfeatloc_ros.ros_io.message_types import CameraInfo, CompressedImage
from gsfeatloc_ros.ros_io.outcome import Outcome
from gsfeatloc_ros.ros_io.pictures import PictureReader
from gsfeatloc_ros.ros_io.raw_image import validate_image
from gsfeatloc_ros.ros_io.schedule import Schedule
from gsfeatloc_ros.ros_io.settings import CONTINUOUS, ON_REQUEST, Settings
from gsfeatloc_ros.ros_io.state import LocalizationState, State
from gsfeatloc_ros.ros_io.transform_tree import MAX_WAIT, TransformError, TransformTree

_INPUT_TOPICS = {
    Role.CAMERA_INFO: InputTopic.CAMERA_INFO,
    Role.PRIOR: InputTopic.PRIOR,
    Role.INITIAL_POSE: InputTopic.INITIAL_POSE,
    Role.ODOMETRY: InputTopic.ODOMETRY,
}
_PRIORS = (Role.PRIOR, Role.INITIAL_POSE)
_TRANSFORMS = (Role.TF, Role.TF_STATIC)
# Nanoseconds of the recording between two looks at what time alone changes, as in the node.
_STATE_PERIOD = 10**9


@dataclass(frozen=True, eq=False)
class StampedPose:
    """The pose of an image that was localized.

    Attributes:
        stamp: of the image, in nanoseconds; when it was recorded, where it has none.
        T_map_body: (4, 4) of the camera, or of the base, as the node publishes it.
        covariance: (6, 6) in ROS order.
    """

    stamp: int
    T_map_body: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class ReplayedImage:
    """What came of an image of the bag.

    Attributes:
        bag_time: when the image was recorded, in nanoseconds.
        stamp: of the image, in nanoseconds; when it was recorded, where it has none; None where it cannot be read.
        outcome: of its localization.
        query: what it was localized with; None where it was not tried.
        pose: as the node publishes it; None unless it was localized.
        state: of the robot afterwards.
    """

    bag_time: int
    stamp: int | None
    outcome: Outcome
    state: State
    query: LocalizerInput | None = None
    pose: StampedPose | None = None

    @property
    def T_map_camera(self) -> np.ndarray | None:
        """The pose (4, 4) of the camera; None unless it was localized."""
        estimate = self.outcome.estimate
        return None if self.pose is None or estimate is None else estimate.T_map_camera


class Replay:
    """Localizes the images of a bag with what was recorded before each, as the node does with what it has received.

    As in the node, a camera_info or prior that cannot be used takes the place of an older good one, and an image for
    which one is missing is refused. Other than the node, which drops images while it is busy, it tries all that are
    due. Its clock is that of the recording. A transform that was recorded a little later than the image of its time is
    waited for, as long as the node would.

    Args:
        bag: open.
        engine: that localizes.
        settings: those of the node; the truth must be in its map frame too.
        calibration: of the camera, until a camera_info comes; None where none is known.

    Attributes:
        truth: stamps in nanoseconds and true poses (4, 4), of what was played up to now.
        unusable: how many messages, other than images, could not be used, by role and reason.
        not_due: number of images that were not due, by the mode and the largest rate.
        unstamped: number of images without a stamp.
        notes: what was assumed of the images.

    Raises:
        ValueError: the settings, or the calibration, cannot be used.
    """

    def __init__(self, bag: Bag, engine: Engine, settings: Settings, calibration: CameraInfo | None = None) -> None:
        if settings.node.mode == ON_REQUEST:
            raise ValueError(f"mode is {ON_REQUEST}, and in a recording nobody asks: set it to {CONTINUOUS}")
        self.notes: list[str] = []
        self._engine, self._settings = engine, settings
        self._stream = _Stream(bag.messages())
        self._tree = TransformTree()
        self._now = self._looked = bag.start
        self._inputs = Inputs(
            settings.prior_policy(),
            self._lookup,
            settings.image.rectified,
            "no camera_info was recorded before this image",
            PictureReader(settings.image.bits, self.notes.append),
        )
        self._inputs.line_delay = settings.image.line_delay
        self._state = LocalizationState(settings.recovery.state, lambda: self._now)
        self._follower = Follower(self._inputs, self._state, settings.node.track)
        self._schedule = Schedule(settings.node)
        self._frames = settings.node.answer_frames()
        if calibration is not None:
            self._inputs.take(InputTopic.CAMERA_INFO, calibration)
        self.truth: list[tuple[int, np.ndarray]] = []
        self.unusable: Counter[tuple[Role, str]] = Counter()
        self.not_due = self.unstamped = 0

    def images(self) -> Iterator[ReplayedImage]:
        """Localize the images in the order in which they were recorded, and yield what comes of each that is due.

        Raises:
            BagError: the bag is damaged from here on.
        """
        for recorded in self._stream:
            self._now = recorded.bag_time
            if self._now >= self._looked + _STATE_PERIOD:
                self._looked = self._now
                self._follower.pass_time(self._settings.node.mode == CONTINUOUS)
            if recorded.role is Role.IMAGE:
                image = self._attempt(recorded)
                if image is not None:
                    yield image
                continue
            try:
                self._take(recorded)
            except ValueError as error:
                self.unusable[recorded.role, str(error)] += 1

    def _take(self, recorded: Recorded) -> None:
        """Take a message that is no image; raise ValueError where it cannot be used."""
        if recorded.role in _TRANSFORMS:
            self._take_transforms(recorded)
        elif recorded.role is Role.TRUTH:
            self._take_truth(recorded)
        else:
            usable = False
            try:
                self._take_input(_INPUT_TOPICS[recorded.role], recorded)
                usable = True
            finally:
                if recorded.role in _PRIORS:
                    self._schedule.take_prior(usable)

    def _take_input(self, topic: InputTopic, recorded: Recorded) -> None:
        if recorded.message is None:
            self._inputs.invalidate(topic, recorded.problem)
            raise ValueError(recorded.problem)
        self._inputs.take(topic, recorded.message)

    def _take_transforms(self, recorded: Recorded) -> None:
        if recorded.message is None:
            raise ValueError(recorded.problem)
        for transform in recorded.message.transforms:
            self._tree.take(transform, static=recorded.role is Role.TF_STATIC)

    def _take_truth(self, recorded: Recorded) -> None:
        if recorded.message is None:
            raise ValueError(recorded.problem)
        header, map_frame = recorded.message.header, self._settings.map.frame_id
        if frame_name(header.frame_id) != map_frame:
            raise ValueError(f"truth is in frame {header.frame_id!r} but the map is in {map_frame!r}")
        stamp = nanoseconds(header.stamp) or recorded.bag_time
        self.truth.append((stamp, decode_pose(recorded.message, recorded.role.value)))

    def _lookup(self, target: str, source: str, stamp: int) -> np.ndarray:
        """Return T_target_source (4, 4) as the node's tf does; raise TransformError where it does not come in time."""
        try:
            return self._tree.lookup(target, source, stamp)
        except TransformError as error:
            missing = error
        for recorded in self._stream.ahead(self._now + int(1e9 * MAX_WAIT)):
            if recorded.role in _TRANSFORMS and recorded.message is not None:
                self._take_transforms(recorded)
                try:
                    return self._tree.lookup(target, source, stamp)
                except TransformError as error:
                    missing = error
        raise missing

    def _attempt(self, recorded: Recorded) -> ReplayedImage | None:
        """Return what came of an image; None where it is not due."""
        message, bag_time = recorded.message, recorded.bag_time
        if message is None:
            return ReplayedImage(bag_time, None, Outcome.refused(recorded.problem), self._standing)
        stamp = nanoseconds(message.header.stamp) or bag_time
        try:
            if not isinstance(message, CompressedImage):
                validate_image(message)
        except ValueError as error:
            return ReplayedImage(bag_time, stamp, Outcome.refused(error), self._standing)
        if not self._schedule.is_due(stamp):
            self.not_due += 1
            return None
        self.unstamped += not nanoseconds(message.header.stamp)
        try:
            return self._localize(recorded, stamp)
        except Exception as error:  # as in the node: not foreseen, and the next image may well do
            return ReplayedImage(bag_time, stamp, Outcome.error(error), self._standing)

    def _localize(self, recorded: Recorded, stamp: int) -> ReplayedImage:
        message, bag_time, follower = recorded.message, recorded.bag_time, self._follower
        try:
            query = follower.for_image(message)
            extrinsics = self._frames.extrinsics(self._lookup, message.header)
        except ValueError as error:
            return ReplayedImage(bag_time, stamp, Outcome.refused(error), self._standing)
        options = follower.options(self._engine.options, message.header, query)
        localizer = self._engine.with_options(options).localizer
        estimate = localizer.localize(query.image, query.camera, query.T_map_camera_prior, query.prior_covariance)
        outcome = Outcome.of(estimate, follower.take(query, message.header, estimate))
        pose = None
        if outcome.localized and estimate.T_map_camera is not None and estimate.covariance is not None:
            pose = StampedPose(stamp, *extrinsics.of_body(estimate.T_map_camera, estimate.covariance))
        return ReplayedImage(bag_time, stamp, outcome, self._standing, query, pose)

    @property
    def _standing(self) -> State:
        return self._state.standing().state


class _Stream:
    """Messages in the order in which they were recorded, of which some may be looked at before their turn."""

    def __init__(self, recorded: Iterator[Recorded]) -> None:
        self._recorded = recorded
        self._seen: deque[Recorded] = deque()
        self._damage: BagError | None = None

    def __iter__(self) -> Iterator[Recorded]:
        while True:
            if not self._seen and not self._read():
                break
            yield self._seen.popleft()
        if self._damage is not None:
            raise self._damage

    def ahead(self, until: int) -> Iterator[Recorded]:
        """Yield what comes next, up to a time in nanoseconds; all of it is yet to have its turn."""
        place = 0
        while place < len(self._seen) or self._read():
            if self._seen[place].bag_time > until:
                return
            yield self._seen[place]
            place += 1

    def _read(self) -> bool:
        """Read one more message; return False where there is none."""
        try:
            self._seen.append(next(self._recorded))
        except StopIteration:
            return False
        except BagError as error:
            self._damage = error
            return False
        return True
