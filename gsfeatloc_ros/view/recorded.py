"""The photos of a bag, small, and the priors that they had."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.replay.bag import Role, open_bag
from gsfeatloc_ros.ros_io.calibration import decode_camera
from gsfeatloc_ros.ros_io.decode import decode_pose, nanoseconds
from gsfeatloc_ros.ros_io.message_types import CameraInfo
from gsfeatloc_ros.ros_io.pictures import PictureReader
from gsfeatloc_ros.view.jpeg import decoded, encoded

# Pixels, as wide as a panel. All photos of a bag are kept, as JPEG.
WIDTH = 400


@dataclass(frozen=True, eq=False)
class SmallPhoto:
    """A photo without distortion: an encoded JPEG, and its pinhole camera."""

    jpeg: np.ndarray
    camera: Camera

    def pixels(self) -> np.ndarray:
        """Return its pixels (H, W, 3) uint8 RGB."""
        return decoded(self.jpeg)


def small_photo(image: np.ndarray, camera: Camera) -> SmallPhoto:
    """Return a photo (H, W, 3) uint8 RGB, small, without the distortion of its camera.

    Raises:
        ValueError: it is not of the camera's size.
    """
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(f"the image is {image.shape[1]}x{image.shape[0]}, not as its camera_info says")
    resized, small = camera.limit(image, WIDTH)
    return SmallPhoto(encoded(small.undistort_image(resized)), small.pinhole())


@dataclass(frozen=True, eq=False)
class Recording:
    """Photos by their stamps in nanoseconds, and the newest prior (4, 4) before each, in the frame that it names."""

    photos: dict[int, SmallPhoto]
    priors: dict[int, np.ndarray]


def read_recording(
    bag: Path, topics: Mapping[Role, Sequence[str]], calibration: CameraInfo | None, stamps: Collection[int]
) -> Recording:
    """Read photos and priors of a bag; what cannot be used of them, or came before any calibration, is left out.

    Args:
        bag: its path.
        topics: of images, and of camera_info and priors where there are some.
        calibration: of the camera, where the bag has none.
        stamps: of the photos that are wanted, nanoseconds.

    Raises:
        ValueError: the bag or the calibration cannot be used.
    """
    camera = None if calibration is None else decode_camera(calibration)
    pictures, found, prior = PictureReader(), Recording({}, {}), None
    with open_bag(bag, topics) as opened:
        for recorded in opened.messages():
            message = recorded.message
            if message is None:
                continue
            try:
                if recorded.role is Role.CAMERA_INFO:
                    camera = decode_camera(message)
                elif recorded.role is Role.PRIOR:
                    prior = decode_pose(message, "prior")
                else:
                    stamp = nanoseconds(message.header.stamp) or recorded.bag_time
                    if stamp in stamps:
                        if prior is not None:
                            found.priors[stamp] = prior
                        if camera is not None:
                            found.photos[stamp] = small_photo(pictures.decode(message), camera)
            except ValueError:
                # What replay refused too, and said why.
                continue
    return found
