"""COLMAP models: ``sparse/0`` in binary or text, and the photos in ``images/``.

COLMAP's poses map the world into the camera, with OpenCV's axes, and its pixels have the centre of the top-left one at
(0.5, 0.5); both are turned into this package's conventions here. As 3DGS and Mip-NeRF360 do, every eighth photo by
name is for testing and the others have made the map.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose
from gsfeatloc_ros.evaluate.dataset import PosedPhoto
from gsfeatloc_ros.evaluate.extras import import_extra

_TEST_EVERY = 8
# Of each of COLMAP's models: which parameters are fx, fy, cx and cy, ours behind it, and which its coefficients are
# (None for 0), see colmap's sensor/models.h.
_MODELS: dict[str, tuple[tuple[int, int, int, int], str, tuple[int | None, ...]]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), "plumb_bob", ()),
    "PINHOLE": ((0, 1, 2, 3), "plumb_bob", ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), "plumb_bob", (3, None, None, None)),
    "RADIAL": ((0, 0, 1, 2), "plumb_bob", (3, 4, None, None)),
    "OPENCV": ((0, 1, 2, 3), "plumb_bob", (4, 5, 6, 7)),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), "equidistant", (4, 5, 6, 7)),
}


def load(folder: Path) -> tuple[list[PosedPhoto], np.ndarray]:
    """Read the test photos and the poses (F, 4, 4) of all photos that COLMAP registered.

    Raises:
        ValueError: the model cannot be read, has no registered photo, or a test photo's camera model is not known.
        RuntimeError: pycolmap is not installed.
    """
    pycolmap = import_extra("pycolmap")
    path = folder / "sparse" / "0"
    try:
        model = pycolmap.Reconstruction(str(path))
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: is not a COLMAP model: {error}") from error
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    if not images:
        raise ValueError(f"{path}: holds no registered image")
    cameras = {}
    photos = []
    for image in images[::_TEST_EVERY]:
        if image.camera_id not in cameras:
            cameras[image.camera_id] = _camera(path, image.camera)
        file = folder / "images" / image.name
        photos.append(PosedPhoto(file.name, file, cameras[image.camera_id], _pose(image)))
    return photos, np.array([_pose(image) for image in images])


def _pose(image: Any) -> np.ndarray:
    """Return T_map_camera (4, 4) of a pycolmap.Image."""
    T_camera_map = image.cam_from_world().matrix()
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
