"""Data sets of the simulated room, written to disk in the layouts that evaluate reads."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert
from gsfeatloc_ros.simulate.photos import SimulatedPhoto, Walk

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenGL's camera axes to ours


def save_image(path: Path, pixels: np.ndarray) -> None:
    """Write an image (H, W, 3 or 4), RGB or RGBA, or a grey one (H, W)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR)
    assert cv2.imwrite(str(path), pixels)


def write_nerf_synthetic(
    folder: Path, angle_x: float, splits: dict[str, Sequence[np.ndarray]], photos: Sequence[np.ndarray]
) -> Path:
    """Write transforms_*.json of poses (4, 4) by split, and the photos (RGBA) of the split "test"."""
    for split, poses in splits.items():
        frames = [
            {"file_path": f"./{split}/r_{index}", "rotation": 0.01, "transform_matrix": (pose @ OPENGL).tolist()}
            for index, pose in enumerate(poses)
        ]
        text = json.dumps({"camera_angle_x": angle_x, "frames": frames})
        (folder / f"transforms_{split}.json").write_text(text, encoding="utf-8")
    for index, photo in enumerate(photos):
        save_image(folder / f"test/r_{index}.png", photo)
    return folder


def angle_x(camera: Camera) -> float:
    """Horizontal field of view, in radians, as NeRF-Synthetic gives it."""
    return 2 * math.atan(0.5 * camera.width / camera.K[0, 0])


def colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's model and parameters of a camera whose distortion has at most k1, k2, p1 and p2."""
    fx, fy, cx, cy = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    return "OPENCV", [fx, fy, cx + 0.5, cy + 0.5, *np.resize(camera.distortion[:4], 4)]


def write_colmap(
    folder: Path, cameras: Sequence[tuple[str, int, int, list[float]]], images: Sequence[tuple], text: bool = False
) -> Path:
    """Write sparse/0 with pycolmap: `cameras` (model, width, height, parameters), `images` (name, camera, pose)."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for index, (name, width, height, parameters) in enumerate(cameras):
        camera = pycolmap.Camera(model=name, width=width, height=height, params=parameters, camera_id=index + 1)
        model.add_camera_with_trivial_rig(camera)
    for index, (name, camera_index, T_map_camera) in enumerate(images):
        image = pycolmap.Image(name=name, camera_id=camera_index + 1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert(T_map_camera)[:3]))
    path = folder / "sparse/0"
    path.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(path))
    return folder


def write_nerfstudio(folder: Path, camera: Camera, photos: Sequence[SimulatedPhoto], map_file: Path) -> Path:
    """Write transforms.json, `photos`, all of them for testing, and the map.

    Frames of a lap round the room, without photos, give the trajectory its radius.
    """
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2", "k3")
    fx, fy, cx, cy = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    values = (fx, fy, cx + 0.5, cy + 0.5, camera.width, camera.height, *camera.distortion)
    names = [f"images/{index}.png" for index in range(len(photos))]
    frames = [
        {"file_path": name, "transform_matrix": (photo.T_map_camera @ OPENGL).tolist()}
        for name, photo in zip(names, photos, strict=True)
    ]
    lap = [Walk(np.zeros(4)).pose(time) for time in range(0, 30, 3)]
    frames += [
        {"file_path": f"images/lap{index}.png", "transform_matrix": (pose @ OPENGL).tolist()}
        for index, pose in enumerate(lap)
    ]
    for name, photo in zip(names, photos, strict=True):
        save_image(folder / name, photo.image)
    transforms = {**dict(zip(keys, values, strict=True)), "frames": frames, "test_filenames": names}
    (folder / "transforms.json").write_text(json.dumps(transforms), encoding="utf-8")
    shutil.copy(map_file, folder / "map.ply")
    return folder
