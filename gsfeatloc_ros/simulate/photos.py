"""Photos of a simulated room from a camera carried through it, with priors and the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, random_unit_vector, so3_exp
from gsfeatloc_ros.simulate.room import Room
from gsfeatloc_ros.simulate.room_camera import RoomCamera

# Errors of the priors in degrees and metres, uniform in these ranges.
PRIOR_ROTATION_DEG = (10.0, 30.0)
PRIOR_TRANSLATION = (0.3, 1.0)
# Metres that cameras keep from every surface.
MIN_CLEARANCE = 0.3
# Seconds between photos, and of the first.
_INTERVAL = 1.0
_START = 100.0


@dataclass(frozen=True, eq=False)
class SimulatedPhoto:
    """A photo with its truth and its prior.

    Attributes:
        stamp: seconds, the middle of the exposure.
        image: (H, W, 3) uint8 RGB as observed, distorted.
        T_map_camera: (4, 4) true pose.
        T_map_camera_prior: (4, 4) prior of that pose.
    """

    stamp: float
    image: np.ndarray
    T_map_camera: np.ndarray
    T_map_camera_prior: np.ndarray


@dataclass(frozen=True, eq=False)
class Walk:
    """A walk round the table of the room, the camera looking across it from side to side, up and down.

    Attributes:
        phases: (4,) radians: of the place, the heading, the pitch and the height.
    """

    phases: np.ndarray

    def pose(self, time: float) -> np.ndarray:
        """Return T_map_camera (4, 4) at a time in seconds; a lap takes half a minute."""
        place, heading, pitch, height = self.phases + time * np.array([2 * np.pi / 30, 0.5, 0.37, 0.29])
        position = np.array([1.75 * np.cos(place), 1.45 * np.sin(place), 1.45 + 0.25 * np.sin(height)])
        inward = np.arctan2(-position[1], -position[0])
        rotation = facing(inward + 1.1 * np.sin(heading), -0.2 + 0.25 * np.sin(pitch), 0.08 * np.sin(heading + pitch))
        return make_pose(rotation, position)


def simulate_photos(room: Room, camera: Camera, count: int, seed: int = 0) -> list[SimulatedPhoto]:
    """Carry `camera` through the room and take `count` photos, one a second, each with a prior.

    Priors are off by PRIOR_ROTATION_DEG about, and by PRIOR_TRANSLATION along, random directions, in free space.
    """
    rng = np.random.default_rng(seed)
    walk = Walk(rng.uniform(0, 2 * np.pi, 4))
    room_camera = RoomCamera(room, camera)
    photos = []
    for index in tqdm(range(count), desc="photos", unit="photo", leave=False, disable=None):
        stamp = _START + index * _INTERVAL
        pose = walk.pose(stamp)
        photos.append(SimulatedPhoto(stamp, room_camera.photo(walk.pose, stamp, rng), pose, perturbed(room, pose, rng)))
    return photos


def perturbed(room: Room, pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a prior for the camera pose (4, 4): off as in simulate_photos, MIN_CLEARANCE away from surfaces."""
    angle = np.radians(rng.uniform(*PRIOR_ROTATION_DEG))
    rotation = pose[:3, :3] @ so3_exp(angle * random_unit_vector(rng))
    while True:
        position = pose[:3, 3] + rng.uniform(*PRIOR_TRANSLATION) * random_unit_vector(rng)
        if room.is_free(position[None], MIN_CLEARANCE)[0]:
            return make_pose(rotation, position)


def facing(heading: float, pitch: float, roll: float = 0.0) -> np.ndarray:
    """Return the rotation (3, 3) from optical to map axes (z up) of a camera that faces a heading, counted from x.

    Radians; a positive pitch looks up, a positive roll turns the camera clockwise about its view.
    """
    forward = np.array([np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    level = np.column_stack([right, np.cross(forward, right), forward])
    return level @ so3_exp(np.array([0.0, 0.0, roll]))
