"""Photos with known poses, and the map of the place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.evaluate.photo_file import read_photo

TEST_EVERY = 8
"""Of data without a split, one photo of so many, by name, is for testing, as in 3DGS and Mip-NeRF360."""


@dataclass(frozen=True, eq=False)
class PosedPhoto:
    """A test photo whose pose is known.

    Attributes:
        name: unique in the scene: the file's, or the path in the scene's folder.
        path: the file.
        camera: that took it.
        T_map_camera: (4, 4) true pose, camera axes as in OpenCV.
    """

    name: str
    path: Path
    camera: Camera
    T_map_camera: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """A map with photos of the same place.

    Attributes:
        name: name of the folder.
        map_path: the map file.
        photos: the test photos, at least one, in the order of the data set.
        trajectory: (F, 4, 4) float64 poses T_map_camera of all frames, those that made the map included.
        background: RGB in [0, 1] that lies behind the objects in the photos and has to lie behind the map: white where
            photos have an alpha channel (they are cut out, and NeRF-Synthetic's convention is white), else black.
    """

    name: str
    map_path: Path
    photos: tuple[PosedPhoto, ...]
    trajectory: np.ndarray
    background: tuple[float, float, float]

    @property
    def camera(self) -> Camera:
        """The camera of the first photo; most scenes have no other."""
        return self.photos[0].camera

    def training_poses(self) -> np.ndarray:
        """Return the poses (T, 4, 4) of the frames that are none of the photos."""
        photos = np.array([photo.T_map_camera for photo in self.photos])
        return np.array([pose for pose in self.trajectory if not np.isclose(pose, photos).all(axis=(1, 2)).any()])

    def read_photo(self, photo: PosedPhoto) -> np.ndarray:
        """Read a photo as RGB (H, W, 3) uint8, composited on the background where it has an alpha channel.

        Raises:
            ValueError: the file is not an image or not of its camera's size.
        """
        width, height = photo.camera.width, photo.camera.height
        pixels = stored = read_photo(photo.path)
        if pixels.shape[:2] != (height, width):
            # COLMAP takes pixels as they are stored, other programs as EXIF says that they are turned.
            pixels = read_photo(photo.path, upright=True)
        if pixels.shape[:2] != (height, width):
            raise ValueError(f"{photo.path}: is {stored.shape[1]}x{stored.shape[0]}, its camera is {width}x{height}")
        if pixels.shape[2] == 3:
            return pixels
        alpha = pixels[..., 3:] / 255.0
        on_background = alpha * pixels[..., :3] + (1.0 - alpha) * 255.0 * np.array(self.background)
        return np.rint(on_background).astype(np.uint8)
