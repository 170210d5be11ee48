"""How many photos of a robot on the floor are found without a prior, by views anywhere and by views on its plane."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from tqdm import tqdm

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, translation_error
from gsfeatloc_ros.index import IndexOptions, build_index
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.match import DEFAULT_MATCHER, create_matcher
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.simulate import Room, cover
from gsfeatloc_ros.simulate.photos import MIN_CLEARANCE, facing
from gsfeatloc_ros.simulate.room import pixel_rays
from gsfeatloc_ros.simulate.room_camera import RoomCamera

_CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 322.0], [0.0, 502.0, 236.0], [0.0, 0.0, 1.0]]))
# Metres of the camera above the floor; standard deviations of its height and, in radians, of its tilt: soft wheels.
_HEIGHT, _HEIGHT_SIGMA, _TILT_SIGMA = 0.35, 0.01, 0.01
# Metres to what it sees, in the median: of a wall before the lens no robot asks.
_MIN_DEPTH = 1.0
# A pose within so many metres is right.
_MAX_ERROR = 0.05


def measure_planar(counts: Sequence[int], photos: int, seed: int = 0) -> list[dict[str, Any]]:
    """Localize photos of a robot in the simulated room without a prior, and print the results.

    Args:
        counts: numbers of views of the indices.
        photos: for each index, the same ones.
        seed: of the room, the photos and the indices.

    Returns:
        A row for each index: "views", "placed" ("anywhere" or "on the plane"), "right", "wrong", and "cpu_ms", the
        median.
    """
    room, matcher = Room(seed), create_matcher(DEFAULT_MATCHER)
    renderer, taken = create_renderer(cover(room)), _photos(room, photos, seed)
    rows = []
    print(f"of {photos} photos   views  placed        right  wrong  CPU ms, median")
    for count in counts:
        for height, placed in ((0.0, "anywhere"), (_HEIGHT, "on the plane")):
            index = build_index(renderer, matcher, IndexOptions(views=count, seed=seed, camera_height=height))
            row = {"views": count, "placed": placed} | _counted(Localizer(renderer, matcher, index=index), taken)
            rows.append(row)
            print(f"{count:>21}  {placed:12}  {row['right']:>5}  {row['wrong']:>5}  {row['cpu_ms']:>14.0f}")
    return rows


def _photos(room: Room, count: int, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Take photos (H, W, 3) from anywhere on the floor, in all directions; return each with its pose (4, 4)."""
    rng, camera = np.random.default_rng(seed), RoomCamera(room, _CAMERA)
    rays, shell = pixel_rays(_CAMERA), room.solids[0]
    photos: list[tuple[np.ndarray, np.ndarray]] = []
    while len(photos) < count:
        ground = shell.centre[:2] + 2 * shell.radius * rng.uniform(-0.5, 0.5, 2)
        position = np.array([*ground, _HEIGHT + _HEIGHT_SIGMA * rng.normal()])
        pose = make_pose(facing(rng.uniform(0, 2 * np.pi), *_TILT_SIGMA * rng.normal(size=2)), position)
        free = room.is_free(position[None], MIN_CLEARANCE)[0]
        if free and np.median(room.cast(rays, pose)[1]) > _MIN_DEPTH:
            photos.append((camera.photo(partial(_still, pose), 0.0, rng), pose))
    return photos


def _still(pose: np.ndarray, time: float) -> np.ndarray:
    return pose


def _counted(localizer: Localizer, photos: Sequence[tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    right = wrong = 0
    spent = []
    for image, pose in tqdm(photos, desc="photos", unit="photo", leave=False, disable=None):
        start = time.process_time()
        found = localizer.localize(image, _CAMERA).T_map_camera
        spent.append(1000.0 * (time.process_time() - start))
        if found is not None:
            is_right = translation_error(found, pose) < _MAX_ERROR
            right, wrong = right + is_right, wrong + (not is_right)
    return {"right": right, "wrong": wrong, "cpu_ms": float(np.median(spent))}
