"""Scene folders in nerfstudio's layout: ``transforms.json`` with ``test_filenames``, and the test photos.

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
from gsfeatloc_ros.evaluate.dataset import PosedPhoto


def load(folder: Path) -> tuple[list[PosedPhoto], np.ndarray]:
    """Read the test photos and the poses (F, 4, 4) of all frames.

    Raises:
        ValueError: transforms.json cannot be read, lacks a key or holds a value that cannot be right.
    """
    path = folder / "transforms.json"
    with naming(path):
        transforms = read_transforms(path)
        camera = _camera(transforms)
        poses = {frame["file_path"]: frame_pose(frame) for frame in transforms["frames"]}
        names = transforms["test_filenames"]
        if not names:
            raise ValueError("test_filenames is empty")
        unposed = [name for name in names if name not in poses]
        if unposed:
            raise ValueError(f"{len(unposed)} test photos have no frame, the first is {unposed[0]}")
    photos = [PosedPhoto(Path(name).name, folder / name, camera, poses[name]) for name in names]
    return photos, np.array(list(poses.values()))


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
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except KeyError as error:
        raise ValueError(f"{path}: lacks the key {error}") from error
    except (TypeError, ValueError, OverflowError, AttributeError) as error:
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


def _camera(transforms: dict) -> Camera:
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
