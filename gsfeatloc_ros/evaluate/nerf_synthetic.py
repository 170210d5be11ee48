"""NeRF-Synthetic ("Blender") scenes: ``transforms_train.json``, ``_val`` and ``_test``, and RGBA photos in PNG.

A file names the horizontal field of view, ``camera_angle_x``, and the photos, without extension; poses are as in
nerfstudio's files.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.evaluate.dataset import PosedPhoto
from gsfeatloc_ros.evaluate.nerfstudio import frame_pose, naming, read_transforms
from gsfeatloc_ros.evaluate.photo_file import photo_size


def load(folder: Path) -> tuple[list[PosedPhoto], np.ndarray]:
    """Read the test photos and the poses (F, 4, 4) of all frames of the files that are there.

    Raises:
        ValueError: a file cannot be read, lacks a key or holds a value that cannot be right; no first test photo.
    """
    poses = []
    for split in ("train", "val"):
        path = folder / f"transforms_{split}.json"
        if path.is_file():
            with naming(path):
                poses += [frame_pose(frame) for frame in read_transforms(path)["frames"]]
    path = folder / "transforms_test.json"
    with naming(path):
        transforms = read_transforms(path)
        frames = [(folder / f"{frame['file_path']}.png", frame_pose(frame)) for frame in transforms["frames"]]
        if not frames:
            raise ValueError("frames is empty")
        half_angle = 0.5 * float(transforms["camera_angle_x"])
        if not 0 < half_angle < math.pi / 2:
            raise ValueError(f"camera_angle_x {2 * half_angle:g} is not between 0 and pi")
    width, height = photo_size(frames[0][0])
    focal_length = 0.5 * width / math.tan(half_angle)
    K = [[focal_length, 0.0, 0.5 * (width - 1)], [0.0, focal_length, 0.5 * (height - 1)], [0.0, 0.0, 1.0]]
    camera = Camera(width, height, np.array(K))
    photos = [PosedPhoto(image.name, image, camera, pose) for image, pose in frames]
    return photos, np.array(poses + [photo.T_map_camera for photo in photos])
