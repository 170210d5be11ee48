"""Scene folders in nerfstudio's layout: ``transforms.json`` and the test photos.

``test_filenames`` are the test photos; without them those that are not in ``train_filenames`` or ``val_filenames``;
without these every eighth by name. Intrinsics of a frame go before those at the top.

nerfstudio's poses are camera-to-world with OpenGL's camera axes (y up, z backward), and its pixels have the centre of
the top-left one at (0.5, 0.5); both are turned into this package's conventions here.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.json_file import read_json
from gsfeatloc_ros.evaluate.dataset import TEST_EVERY, PosedPhoto

_TEST, _OTHERS = "test_filenames", ("train_filenames", "val_filenames")
# Of the models of nerfstudio's cameras those of a perspective camera, whose keys are the same, and the fisheye.
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = "OPENCV_FISHEYE"
_OPENCV_KEYS = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE_KEYS = ("k1", "k2", "k3", "k4")
# Of other programs: a rational, a thin prism's, and Metashape's coefficients.
_NOT_MODELLED = ("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "p3", "p4")


def load(folder: Path) -> tuple[list[PosedPhoto], np.ndarray]:
    """Read the test photos and the poses (F, 4, 4) of all frames.

    Raises:
        ValueError: transforms.json cannot be read, lacks a key or holds a value that cannot be right.
    """
    path = folder / "transforms.json"
    with naming(path):
        transforms = read_transforms(path)
        frames = {frame["file_path"]: frame for frame in transforms["frames"]}
        if not frames:
            raise ValueError("frames is empty")
        poses = {name: frame_pose(frame) for name, frame in frames.items()}
        names = _test_names(transforms, list(frames))
        unposed = [name for name in names if name not in poses]
        if unposed:
            raise ValueError(f"{len(unposed)} test photos have no frame, the first is {unposed[0]}")
        photos = [
            PosedPhoto(Path(name).name, folder / name, _camera(transforms | frames[name]), poses[name])
            for name in names
        ]
    return photos, np.array(list(poses.values()))


def _test_names(transforms: dict, names: list[str]) -> list[str]:
    """Return the names of the test photos out of those of all."""
    if _TEST in transforms:
        if not transforms[_TEST]:
            raise ValueError(f"{_TEST} is empty")
        return transforms[_TEST]
    others = {name for key in _OTHERS for name in transforms.get(key, ())}
    if others:
        left = [name for name in names if name not in others]
        if not left:
            raise ValueError(f"it has no {_TEST}, and {' and '.join(_OTHERS)} leave no frame")
        return left
    return sorted(names)[::TEST_EVERY]


def load_poses(path: Path) -> np.ndarray:
    """Read the poses (F, 4, 4) of all frames of a transforms file; raise ValueError where there is none."""
    with naming(path):
        poses = [frame_pose(frame) for frame in read_transforms(path)["frames"]]
        if not poses:
            raise ValueError("frames is empty")
    return np.array(poses)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turn what goes wrong while a transforms file is read into a ValueError that names it."""
    try:
        yield
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except KeyError as error:
        raise ValueError(f"{path}: lacks the key {error}") from error
    except (TypeError, OverflowError, AttributeError) as error:
        raise ValueError(f"{path}: is not as nerfstudio writes it: {error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_transforms(path: Path) -> dict:
    """Read a transforms file."""
    transforms = read_json(path)
    if not isinstance(transforms, dict):
        raise ValueError("is not a JSON object")
    return transforms


def frame_pose(frame: dict) -> np.ndarray:
    """Return T_map_camera (4, 4) of a frame, whose own pose has OpenGL's camera axes."""
    T_map_opengl = np.array(frame["transform_matrix"], dtype=np.float64)
    if T_map_opengl.shape != (4, 4) or not np.isfinite(T_map_opengl).all():
        raise ValueError(f"transform_matrix of {frame['file_path']} is not a finite 4x4 matrix")
    rotation = T_map_opengl[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) or np.linalg.det(rotation) < 0:
        raise ValueError(f"transform_matrix of {frame['file_path']} is not a rigid pose")
    return T_map_opengl @ np.diag([1.0, -1.0, -1.0, 1.0])


def _camera(intrinsics: dict) -> Camera:
    """Return the camera by its keys, of which a lens that cannot be modelled is refused by name."""
    fisheye, model = intrinsics.get("is_fisheye", False), intrinsics.get("camera_model")
    if fisheye and model not in (None, _FISHEYE):
        raise ValueError(f"is_fisheye is true, but camera_model is {model}: remove the one that is wrong")
    model = model or (_FISHEYE if fisheye else "OPENCV")
    if model not in (*_PERSPECTIVE, _FISHEYE):
        raise ValueError(f"camera_model {model} is not one of {', '.join((*_PERSPECTIVE, _FISHEYE))}")
    names, unused = (_FISHEYE_KEYS, _OPENCV_KEYS) if model == _FISHEYE else (_OPENCV_KEYS, _FISHEYE_KEYS)
    beyond = [key for key in (*unused, *_NOT_MODELLED) if key not in names and intrinsics.get(key)]
    if beyond:
        raise ValueError(
            f"{', '.join(beyond)} of a lens of camera_model {model} cannot be used: undistort the photos first"
        )
    K = np.array(
        [
            [intrinsics["fl_x"], 0.0, intrinsics["cx"] - 0.5],
            [0.0, intrinsics["fl_y"], intrinsics["cy"] - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    distortion = np.array([intrinsics.get(key, 0.0) for key in names])
    ros_model = "equidistant" if model == _FISHEYE else "plumb_bob"
    return Camera(int(intrinsics["w"]), int(intrinsics["h"]), K, distortion, ros_model)
