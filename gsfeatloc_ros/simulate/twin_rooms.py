"""Two rooms that are alike but for some posters: which of them a photo shows, only these tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.simulate.photos import simulate_photos
from gsfeatloc_ros.simulate.room import TEXEL, Room, pixel_rays
from gsfeatloc_ros.simulate.room_map import cover
from gsfeatloc_ros.simulate.texture import paint

# Where the second room is, T_map_room (4, 4): so many metres along x.
SECOND = make_pose(np.eye(3), np.array([9.0, 0.0, 0.0]))
# Side of a poster in metres.
_POSTER = 0.3
# Colours that are farther apart than this, of 1, are seen to differ.
_VISIBLE = 0.05


@dataclass(frozen=True, eq=False)
class TwinPhoto:
    """A photo taken in one of the rooms.

    Attributes:
        image: (H, W, 3) uint8 RGB as observed, distorted.
        poses: (4, 4) each, T_map_camera where it was taken, and at the same place of the other room.
        different: share of its pixels that look different in the other room.
    """

    image: np.ndarray
    poses: tuple[np.ndarray, np.ndarray]
    different: float


class TwinRooms:
    """A room and another beside it that is like it, but for posters on a `share` of its surfaces."""

    def __init__(self, room: Room, share: float, seed: int = 0) -> None:
        self.rooms = (room, room.copy())
        _hang_posters(self.rooms[1], share, np.random.default_rng(seed))

    def cover(self) -> GaussianMap:
        """Return the map of both; its frame is that of the first."""
        first, second = (cover(room) for room in self.rooms)
        moved = Similarity(translation=SECOND[:3, 3]).transform(second.means).astype(np.float32)
        return GaussianMap(
            means=np.concatenate([first.means, moved]),
            scales=np.concatenate([first.scales, second.scales]),
            rotations=np.concatenate([first.rotations, second.rotations]),
            opacities=np.concatenate([first.opacities, second.opacities]),
            sh=np.concatenate([first.sh, second.sh]),
        )

    def photos(self, camera: Camera, count: int, seed: int = 0) -> list[TwinPhoto]:
        """Take photos, every second of them in the second room."""
        places = (np.eye(4), SECOND)
        taken = []
        for number, (room, other) in enumerate((self.rooms, self.rooms[::-1])):
            here, there = places[number], places[1 - number]
            for photo in simulate_photos(room, camera, (count + 1 - number) // 2, 2 * seed + number):
                pose = photo.T_map_camera
                different = _difference(room, other, camera, pose)
                taken.append(TwinPhoto(photo.image, (here @ pose, there @ pose), different))
        return taken


def _hang_posters(room: Room, share: float, rng: np.random.Generator) -> None:
    """Cover a share of the room's surfaces with posters, by chance anywhere on them."""
    side = round(_POSTER / TEXEL)
    faces = [picture for solid in room.pictures for picture in solid if min(picture.shape[:2]) > side]
    areas = np.array([picture.shape[0] * picture.shape[1] for picture in faces], np.float64)
    for face in rng.choice(len(faces), round(share * areas.sum() / side**2), p=areas / areas.sum()):
        row, column = (rng.integers(length - side) for length in faces[face].shape[:2])
        faces[face][row : row + side, column : column + side] = paint(rng, side, side, TEXEL)


def _difference(room: Room, other: Room, camera: Camera, T_room_camera: np.ndarray) -> float:
    """Return the share of pixels that look different from the same pose (4, 4) in the other room."""
    rays = pixel_rays(camera)
    here, there = (which.cast(rays, T_room_camera)[0] for which in (room, other))
    return float((np.abs(here - there).max(axis=2) > _VISIBLE).mean())
