"""The localizer on a recorded bag: as the node, but without ROS, and with every image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.replay.bag import Bag, Recorded
from gsfeatloc_ros.ros_io.decode import decode_pose, nanoseconds
from gsfeatloc_ros.ros_io.inputs import Inputs, PriorPolicy


@dataclass(frozen=True, eq=False)
class Answer:
    """What came of an image.

    Attributes:
        bag_time: when the image was recorded, in nanoseconds.
        stamp: of the image, in nanoseconds; None where it could not be read.
        status: that of the Estimate in words; "refused" if the image could not be tried, "error" for a bug met on it.
        reason: one sentence in words.
        T_map_camera_prior: (4, 4) prior it was tried with, else None.
        estimate: without its pictures; None where it was not tried.
    """

    bag_time: int
    stamp: int | None
    status: str
    reason: str
    T_map_camera_prior: np.ndarray | None = None
    estimate: Estimate | None = None

    @property
    def localized(self) -> bool:
        """Whether there is a pose to use."""
        return self.estimate is not None and self.estimate.localized


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
            "no prior was recorded before this image",
        )
        self.truth: list[tuple[int, np.ndarray]] = []
        self.unusable: Counter[tuple[str, str]] = Counter()

    def answers(self) -> Iterator[Answer]:
        """What comes of each image, in the order in which they were recorded.

        Raises:
            BagError: the bag is damaged from here on.
        """
        take = {
            "camera_info": self._inputs.take_camera_info,
            "prior": self._inputs.take_prior,
            "truth": self._take_truth,
        }
        for recorded in self._bag.messages():
            if recorded.role == "image":
                yield self._attempt(recorded)
                continue
            try:
                take[recorded.role](_content(recorded))
            except ValueError as error:
                self.unusable[recorded.role, str(error)] += 1
                self._inputs.lose(recorded.role, str(error))

    def _take_truth(self, message: Any) -> None:
        map_frame = self._inputs.policy.map_frame
        if message.header.frame_id != map_frame:
            raise ValueError(f"truth is in frame {message.header.frame_id!r} but the map is in {map_frame!r}")
        self.truth.append((nanoseconds(message.header.stamp), decode_pose(message, "truth")))

    def _attempt(self, recorded: Recorded) -> Answer:
        stamp = None if recorded.message is None else nanoseconds(recorded.message.header.stamp)
        try:
            return self._localize(recorded, stamp)
        except Exception as error:  # as in the node: not foreseen, and the next image may well do
            return Answer(recorded.bag_time, stamp, "error", f"{type(error).__name__}: {error}")

    def _localize(self, recorded: Recorded, stamp: int | None) -> Answer:
        try:
            query = self._inputs.query(_content(recorded))
        except ValueError as error:
            return Answer(recorded.bag_time, stamp, "refused", str(error))
        prior = query.T_map_camera_prior
        estimate = self._localizer.localize(query.image, query.camera, prior, query.prior_covariance)
        # The pictures of thousands of images would fill the memory.
        estimate = replace(estimate, correspondences=None, last_render=None)
        return Answer(recorded.bag_time, stamp, estimate.status.value, estimate.reason, prior, estimate)


def _content(recorded: Recorded) -> Any:
    if recorded.message is None:
        raise ValueError(recorded.problem)
    return recorded.message


def _no_tf(target: str, source: str, stamp: int) -> np.ndarray:
    raise ValueError("replay knows no tf: give priors of the camera in the map's frame, or its name (--map-frame)")
