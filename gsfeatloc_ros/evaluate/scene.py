"""Scenes of real photos with known poses, in nerfstudio's layout."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsfeatloc_ros.camera import Camera

_BLACK = (0.0, 0.0, 0.0)
_WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Photo:
    """A test photo: its file and the pose (4, 4) it was taken from, camera axes as in OpenCV."""

    path: Path
    T_map_camera: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """A map with photos of the same place.

    Attributes:
        name: name of the folder.
        map_path: the map file.
        camera: the camera that took all photos.
        photos: the test photos, in the order of the file.
        trajectory: (F, 4, 4) float64 poses T_map_camera of all frames, those that made the map included.
        background: RGB in [0, 1] that lies behind the objects in the photos and has to lie behind the map: white where
            photos have an alpha channel (they are cut out, and NeRF-Synthetic's convention is white), else black.
    """

    name: str
    map_path: Path
    camera: Camera
    photos: tuple[Photo, ...]
    trajectory: np.ndarray
    background: tuple[float, float, float]

    def read_photo(self, photo: Photo) -> np.ndarray:
        """Read a photo as RGB (H, W, 3) uint8, composited on the background where it has an alpha channel.

        Raises:
            ValueError: the file is not an image or not of the camera's size.
        """
        pixels = _read_image(photo.path)
        if pixels.shape[:2] != (self.camera.height, self.camera.width):
            raise ValueError(
                f"{photo.path}: is {pixels.shape[1]}x{pixels.shape[0]}, transforms.json says "
                f"{self.camera.width}x{self.camera.height}"
            )
        if pixels.shape[2] == 3:
            return pixels
        alpha = pixels[..., 3:] / 255.0
        on_background = alpha * pixels[..., :3] + (1.0 - alpha) * 255.0 * np.array(self.background)
        return np.rint(on_background).astype(np.uint8)


def load_scene(folder: str | Path) -> Scene:
    """Read a scene folder: ``map.ply``, nerfstudio's ``transforms.json`` with ``test_filenames``, and the test photos.

    nerfstudio's poses are camera-to-world with OpenGL's camera axes (y up, z backward), and its pixels have the centre
    of the top-left one at (0.5, 0.5); both are turned into this package's conventions here.

    Raises:
        ValueError: a file is missing, transforms.json lacks a key or holds a value that cannot be right.
    """
    folder = Path(folder).resolve()
    path = folder / "transforms.json"
    try:
        transforms = json.loads(path.read_text(encoding="utf-8"))
        camera = _camera(transforms)
        poses = {frame["file_path"]: _pose(frame) for frame in transforms["frames"]}
        names = transforms["test_filenames"]
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except KeyError as error:
        raise ValueError(f"{path}: lacks the key {error}") from error
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
    if not names:
        raise ValueError(f"{path}: test_filenames is empty")
    unposed = [name for name in names if name not in poses]
    if unposed:
        raise ValueError(f"{path}: {len(unposed)} test photos have no frame, the first is {unposed[0]}")
    photos = tuple(Photo(folder / name, poses[name]) for name in names)
    missing = [photo.path.name for photo in photos if not photo.path.is_file()]
    if missing:
        raise ValueError(
            f"{folder}: {len(missing)} of {len(photos)} test photos are missing, the first is {missing[0]}"
        )
    return Scene(
        name=folder.name,
        map_path=folder / "map.ply",
        camera=camera,
        photos=photos,
        trajectory=np.array(list(poses.values())),
        background=_WHITE if _read_image(photos[0].path).shape[2] == 4 else _BLACK,
    )


def _camera(transforms: dict) -> Camera:
    if not isinstance(transforms, dict):
        raise ValueError("is not a JSON object")
    model = transforms.get("camera_model", "OPENCV")
    if model not in ("OPENCV", "PINHOLE"):
        raise ValueError(f"camera_model {model} is not OPENCV or PINHOLE")
    K = np.array(
        [
            [transforms["fl_x"], 0.0, transforms["cx"] - 0.5],
            [0.0, transforms["fl_y"], transforms["cy"] - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    distortion = [transforms.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]
    return Camera(int(transforms["w"]), int(transforms["h"]), K, np.array(distortion))


def _pose(frame: dict) -> np.ndarray:
    """T_map_camera (4, 4) of a frame."""
    T_map_opengl = np.array(frame["transform_matrix"], dtype=np.float64)
    if T_map_opengl.shape != (4, 4) or not np.isfinite(T_map_opengl).all():
        raise ValueError(f"transform_matrix of {frame['file_path']} is not a finite 4x4 matrix")
    rotation = T_map_opengl[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise ValueError(f"transform_matrix of {frame['file_path']} is not a rigid pose")
    return T_map_opengl @ np.diag([1.0, -1.0, -1.0, 1.0])


def _read_image(path: Path) -> np.ndarray:
    """Read an image as RGB or, where it has an alpha channel, RGBA: (H, W, 3 or 4) uint8."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError(f"{path}: is not an image")
    if pixels.dtype != np.uint8 or pixels.ndim != 3:
        raise ValueError(f"{path}: is not an 8-bit colour image")
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA if pixels.shape[2] == 4 else cv2.COLOR_BGR2RGB)
