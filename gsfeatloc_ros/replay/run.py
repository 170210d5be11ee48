"""The localizer on a recorded bag: as the node, but without ROS, and with every image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.replay.bag import Bag, Recorded, Role
from gsfeatloc_ros.ros_io.decode import decode_pose, nanoseconds
from gsfeatloc_ros.ros_io.inputs import Inputs, InputTopic
from gsfeatloc_ros.ros_io.outcome import Outcome
from gsfeatloc_ros.ros_io.prior import PriorPolicy

_INPUT_TOPICS = {Role.CAMERA_INFO: InputTopic.CAMERA_INFO, Role.PRIOR: InputTopic.PRIOR}


@dataclass(frozen=True, eq=False)
class StampedPose:
    """The pose of an image that was localized.

    Attributes:
        stamp: of the image, in nanoseconds.
        T_map_camera: (4, 4).
        covariance: (6, 6) in ROS order.
    """

    stamp: int
    T_map_camera: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, eq=False)
class ReplayedImage:
    """What came of an image of the bag.

    Attributes:
        bag_time: when the image was recorded, in nanoseconds.
        stamp: of the image, in nanoseconds; None where it could not be read.
        outcome: of its localization.
        T_map_camera_prior: (4, 4) prior it was tried with; None where it was not tried.
    """

    bag_time: int
    stamp: int | None
    outcome: Outcome
    T_map_camera_prior: np.ndarray | None = None

    @property
    def pose(self) -> StampedPose | None:
        """Where it was taken; None unless it was localized."""
        estimate = self.outcome.estimate
        if estimate is None or estimate.T_map_camera is None or estimate.covariance is None or self.stamp is None:
            return None
        return StampedPose(self.stamp, estimate.T_map_camera, estimate.covariance)


class Replay:
    """Localizes every image of a bag with the camera_info and the prior that were recorded last before it.

    As in the node, a camera_info or prior that cannot be used takes the place of an older good one, and an image for
    which one is missing is refused. Other than the node, which drops images while it is busy, it tries them all. It
    knows no tf: priors are of the camera, in the map's frame.

    Args:
        bag: open.
        localizer: of the map.
        policy: what priors are worth; the truth must be in its map frame too.
        rectified: whether the images are; then the camera is that of camera_info's P.

    Attributes:
        truth: stamps in nanoseconds and true poses (4, 4), of what was played up to now.
        unusable: how many messages, other than images, could not be used, by role and reason.
    """

    def __init__(self, bag: Bag, localizer: Localizer, policy: PriorPolicy, rectified: bool = False) -> None:
        self._bag, self._localizer = bag, localizer
        self._inputs = Inputs(
            policy,
            _no_tf,
            rectified,
            "no camera_info was recorded before this image",
        )
        self.truth: list[tuple[int, np.ndarray]] = []
        self.unusable: Counter[tuple[Role, str]] = Counter()

    def images(self) -> Iterator[ReplayedImage]:
        """Localize the images in the order in which they were recorded, and yield what comes of each.

        Raises:
            BagError: the bag is damaged from here on.
        """
        for recorded in self._bag.messages():
            if recorded.role is Role.IMAGE:
                yield self._attempt(recorded)
                continue
            try:
                self._take(recorded)
            except ValueError as error:
                self.unusable[recorded.role, str(error)] += 1

    def _take(self, recorded: Recorded) -> None:
        """Take a message that is no image; raise ValueError where it cannot be used."""
        topic = _INPUT_TOPICS.get(recorded.role)
        if recorded.message is None:
            if topic is not None:
                self._inputs.invalidate(topic, recorded.problem)
            raise ValueError(recorded.problem)
        if topic is not None:
            self._inputs.take(topic, recorded.message)
            return
        header, map_frame = recorded.message.header, self._inputs.policy.map_frame
        if header.frame_id != map_frame:
            raise ValueError(f"truth is in frame {header.frame_id!r} but the map is in {map_frame!r}")
        self.truth.append((nanoseconds(header.stamp), decode_pose(recorded.message, recorded.role.value)))

    def _attempt(self, recorded: Recorded) -> ReplayedImage:
        if recorded.message is None:
            return ReplayedImage(recorded.bag_time, None, Outcome.refused(recorded.problem))
        stamp = nanoseconds(recorded.message.header.stamp)
        try:
            outcome, prior = self._localize(recorded)
        except Exception as error:  # as in the node: not foreseen, and the next image may well do
            outcome, prior = Outcome.error(error), None
        return ReplayedImage(recorded.bag_time, stamp, outcome, prior)

    def _localize(self, recorded: Recorded) -> tuple[Outcome, np.ndarray | None]:
        """Return what came of an image, and the prior (4, 4) it was tried with."""
        try:
            query = self._inputs.for_image(recorded.message)
        except ValueError as error:
            return Outcome.refused(error), None
        prior = query.T_map_camera_prior
        return Outcome.of(self._localizer.localize(query.image, query.camera, prior, query.prior_covariance)), prior


def _no_tf(target: str, source: str, stamp: int) -> np.ndarray:
    raise ValueError("replay knows no tf: give priors of the camera in the map's frame, or its name (--map-frame)")
