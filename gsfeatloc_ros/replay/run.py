"""The localizer on a recorded bag: as the node, but without ROS, and with every image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.estimate import Estimate
from gsfeatloc_ros.localize import Localizer
from gsfeatloc_ros.messages import (
    Prior,
    decode_camera,
    decode_compressed_image,
    decode_image,
    decode_pose,
    decode_prior,
    decode_prior_covariance,
)
from gsfeatloc_ros.replay.bag import COMPRESSED_IMAGE, Bag, Recorded

T = TypeVar("T")


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
    which one is missing is refused. Other than the node, which drops images while it is busy, it tries them all.

    Args:
        bag: open.
        localizer: of the map.
        map_frame: name of the map's frame, in which priors and the truth must be.
        rectified: whether the images are; then the camera is that of camera_info's P.

    Attributes:
        truth: stamps in nanoseconds and true poses (4, 4), of what was played up to now.
        unusable: how many messages, other than images, could not be used, by role and reason.
    """

    def __init__(self, bag: Bag, localizer: Localizer, map_frame: str, rectified: bool = False) -> None:
        self._bag, self._localizer, self._map_frame, self._rectified = bag, localizer, map_frame, rectified
        # Or what is wrong with the newest.
        self._camera: Camera | str = "no camera_info was recorded before this image"
        self._prior: Prior | str = "no prior was recorded before this image"
        self.truth: list[tuple[int, np.ndarray]] = []
        self.unusable: Counter[tuple[str, str]] = Counter()

    def answers(self) -> Iterator[Answer]:
        """What comes of each image, in the order in which they were recorded.

        Raises:
            BagError: the bag is damaged from here on.
        """
        for recorded in self._bag.messages():
            if recorded.role == "image":
                yield self._attempt(recorded)
                continue
            try:
                self._take(recorded)
            except ValueError as error:
                self.unusable[recorded.role, str(error)] += 1
                if recorded.role == "camera_info":
                    self._camera = str(error)
                elif recorded.role == "prior":
                    self._prior = str(error)

    def _take(self, recorded: Recorded) -> None:
        message = _content(recorded)
        if recorded.role == "camera_info":
            self._camera = decode_camera(message, self._rectified)
        elif recorded.role == "prior":
            self._prior = Prior(decode_prior(message, self._map_frame), decode_prior_covariance(message))
        else:
            self.truth.append((_nanoseconds(message), decode_pose(message, self._map_frame, "truth")))

    def _attempt(self, recorded: Recorded) -> Answer:
        stamp = None if recorded.message is None else _nanoseconds(recorded.message)
        try:
            return self._localize(recorded, stamp)
        except Exception as error:  # as in the node: not foreseen, and the next image may well do
            return Answer(recorded.bag_time, stamp, "error", f"{type(error).__name__}: {error}")

    def _localize(self, recorded: Recorded, stamp: int | None) -> Answer:
        try:
            image, camera, prior = _pixels(recorded), _usable(self._camera), _usable(self._prior)
            height, width = image.shape[:2]
            if (camera.width, camera.height) != (width, height):
                raise ValueError(
                    f"camera_info is for {camera.width}x{camera.height} but the image is {width}x{height}: take the "
                    "camera_info of this image"
                )
        except ValueError as error:
            return Answer(recorded.bag_time, stamp, "refused", str(error))
        estimate = self._localizer.localize(image, camera, prior.T_map_camera, prior.covariance)
        # The pictures of thousands of images would fill the memory.
        estimate = replace(estimate, correspondences=None, last_render=None)
        return Answer(recorded.bag_time, stamp, estimate.status.value, estimate.reason, prior.T_map_camera, estimate)


def _usable(value: T | str) -> T:
    """The value, unless what is wrong with it took its place."""
    if isinstance(value, str):
        raise ValueError(value)
    return value


def _content(recorded: Recorded) -> Any:
    if recorded.message is None:
        raise ValueError(recorded.problem)
    return recorded.message


def _pixels(recorded: Recorded) -> np.ndarray:
    message = _content(recorded)
    return decode_compressed_image(message) if recorded.kind == COMPRESSED_IMAGE else decode_image(message)


def _nanoseconds(message: Any) -> int:
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
