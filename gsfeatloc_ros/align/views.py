"""Photos whose poses are known: those of a bag that were localized, or those of a scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from gsfeatloc_ros.align.pairs import Answer
from gsfeatloc_ros.align.target import View
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.replay.bag import Role, open_bag
from gsfeatloc_ros.ros_io.calibration import decode_camera
from gsfeatloc_ros.ros_io.decode import nanoseconds
from gsfeatloc_ros.ros_io.message_types import CameraInfo, CompressedImage
from gsfeatloc_ros.ros_io.pictures import PictureReader
from gsfeatloc_ros.ros_io.raw_image import validate_image


def views_of_bag(
    path: Path,
    topics: dict[Role, list[str]],
    answers: Sequence[Answer],
    calibration: CameraInfo | None,
    rectified: bool,
) -> Iterator[View]:
    """Yield the photos of a bag that were localized.

    Args:
        path: of the bag.
        topics: of images, and of camera_info where there is some.
        answers: with the stamps of the images.
        calibration: of the camera, where the bag has none.
        rectified: whether the images are.

    Raises:
        ValueError: the bag, or the calibration, cannot be used.
    """
    poses = {answer.stamp: answer.T_map_camera for answer in answers}
    camera: Camera | None = None if calibration is None else decode_camera(calibration, rectified)
    pictures = PictureReader()
    with open_bag(path, topics) as bag:
        for recorded in bag.messages():
            if recorded.message is None:
                continue
            if recorded.role is Role.CAMERA_INFO:
                camera = decode_camera(recorded.message, rectified)
            elif recorded.role is Role.IMAGE and camera is not None:
                pose = poses.get(nanoseconds(recorded.message.header.stamp) or recorded.bag_time)
                if pose is not None:
                    if not isinstance(recorded.message, CompressedImage):
                        validate_image(recorded.message)
                    yield View(pictures.decode(recorded.message), camera, pose)


def views_of_scene(folder: Path, S_map_scene: Similarity) -> Iterator[View]:
    """Yield the test photos of a scene, as evaluate reads it, where the map lies by a similarity.

    Raises:
        ValueError: the folder is no scene.
    """
    # The map does not matter.
    scene = load_scene(folder, folder)
    for photo in scene.photos:
        yield View(scene.read_photo(photo), photo.camera, S_map_scene.transform_pose(photo.T_map_camera))
