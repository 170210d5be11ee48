"""COLMAP models: ``sparse/0``, or ``sparse`` itself, in binary or text, and the photos in ``images/``.

COLMAP's poses map the world into the camera, with OpenCV's axes, and its pixels have the centre of the top-left one at
(0.5, 0.5); both are turned into this package's conventions here. As 3DGS and Mip-NeRF360 do, every eighth photo by
name is for testing and the others have made the map. Photos may be smaller than the model's cameras say.
"""

from __future__ import annotations

import copy
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose
from gsfeatloc_ros.evaluate.colmap_files import copy_without_points
from gsfeatloc_ros.evaluate.dataset import TEST_EVERY, PosedPhoto
from gsfeatloc_ros.evaluate.extras import import_extra

# Of each of COLMAP's models: which parameters are fx, fy, cx and cy, ours behind it, and which its coefficients are
# (None for 0), see colmap's sensor/models.h.
_MODELS: dict[str, tuple[tuple[int, int, int, int], str, tuple[int | None, ...]]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), "plumb_bob", ()),
    "PINHOLE": ((0, 1, 2, 3), "plumb_bob", ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), "plumb_bob", (3, None, None, None)),
    "RADIAL": ((0, 0, 1, 2), "plumb_bob", (3, 4, None, None)),
    "OPENCV": ((0, 1, 2, 3), "plumb_bob", (4, 5, 6, 7)),
    "FULL_OPENCV": ((0, 1, 2, 3), "rational_polynomial", (4, 5, 6, 7, 8, 9, 10, 11)),
    "SIMPLE_RADIAL_FISHEYE": ((0, 0, 1, 2), "equidistant", (3, None, None, None)),
    "RADIAL_FISHEYE": ((0, 0, 1, 2), "equidistant", (3, 4, None, None)),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), "equidistant", (4, 5, 6, 7)),
}


def load(folder: Path) -> tuple[list[PosedPhoto], np.ndarray]:
    """Read the test photos and the poses (F, 4, 4) of all photos that COLMAP registered.

    Raises:
        ValueError: the model cannot be read, has no registered photo, or a test photo's camera model is not known.
        RuntimeError: pycolmap is not installed.
    """
    pycolmap = import_extra("pycolmap")
    path = folder / "sparse"
    path = path / "0" if (path / "0").is_dir() else path
    try:
        images = _registered(pycolmap, path)
    except OSError as error:
        raise ValueError(f"{path}: is not a COLMAP model: {error.strerror or error}") from error
    # pycolmap passes on whatever the standard library of C++ raises.
    except (ValueError, RuntimeError, LookupError, ArithmeticError, MemoryError) as error:
        raise ValueError(f"{path}: is not a COLMAP model: {error or type(error).__name__}") from error
    if not images:
        raise ValueError(f"{path}: holds no registered image")
    cameras = {}
    photos = []
    for image in images[::TEST_EVERY]:
        if image.camera.camera_id not in cameras:
            cameras[image.camera.camera_id] = _camera(path, image.camera)
        file = folder / "images" / image.name
        photos.append(PosedPhoto(file.name, file, cameras[image.camera.camera_id], image.T_map_camera))
    return photos, np.array([image.T_map_camera for image in images])


class _Image(NamedTuple):
    """A photo that COLMAP registered, taken by a pycolmap.Camera."""

    name: str
    camera: Any
    T_map_camera: np.ndarray


def _registered(pycolmap: ModuleType, path: Path) -> list[_Image]:
    """Return the registered images of a model by name."""

    def parameters(model: int) -> int:
        return len(pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId(model), 1.0, 1, 1).params)

    with tempfile.TemporaryDirectory() as folder:
        copy_without_points(path, Path(folder), parameters)
        model = pycolmap.Reconstruction(folder)
    # The model's own cameras are gone with it.
    images = [
        _Image(image.name, copy.copy(image.camera), _pose(image)) for image in model.images.values() if image.has_pose
    ]
    return sorted(images, key=lambda image: image.name)


def _pose(image: Any) -> np.ndarray:
    """Return T_map_camera (4, 4) of a pycolmap.Image."""
    T_camera_map = image.cam_from_world().matrix()
    if not np.isfinite(T_camera_map).all():
        raise ValueError(f"the pose of {image.name} is not finite")
    return invert(make_pose(T_camera_map[:, :3], T_camera_map[:, 3]))


def _camera(path: Path, camera: Any) -> Camera:
    """Return the Camera of a pycolmap.Camera."""
    name = camera.model.name
    if name not in _MODELS:
        raise ValueError(f"{path}: camera model {name} is not one of {', '.join(_MODELS)}: undistort the images first")
    pinhole, model, coefficients = _MODELS[name]
    fx, fy, cx, cy = camera.params[list(pinhole)]
    K = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    distortion = [0.0 if index is None else camera.params[index] for index in coefficients]
    return Camera(camera.width, camera.height, K, np.array(distortion), model)
