"""A made-up building of any number of rooms, all alike in density, made room by room: to measure large maps on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.simulate.boxes import cover_boxes, looking_at

# As many as in half of two_rooms' map of a million.
ROOM_GAUSSIANS = 500_000
# Rooms of a storey lie on both sides of a corridor.
ROOMS_OF_A_STOREY = 10
_ROOM, _CORRIDOR, _STOREY = np.array([5.0, 4.0, 2.7]), np.array([5.0, 1.0, 2.7]), 3.0
# Of the corridor, along y.
_MIDDLE = _ROOM[1] + _CORRIDOR[1]
# A part of the corridor is open along it: what is in its box, made longer by this and narrower.
_ENDS = np.array([[-0.1, 0.05, 0.05], [0.1, -0.05, -0.05]])
_DOOR_WIDTH, _DOOR_HEIGHT = 1.0, 2.1
# Furniture of a room: how many pieces, and the least and largest of them, metres.
_PIECES = (4, 8)
_SMALLEST, _LARGEST = np.array([0.4, 0.4, 0.4]), np.array([1.8, 1.0, 2.0])
_EYES = 1.5


class Building:
    """Storeys of furnished rooms along corridors.

    Args:
        rooms: how many.
        seed: another one gives other furniture and colours.
    """

    def __init__(self, rooms: int, seed: int = 0) -> None:
        self.rooms, self._seed = rooms, seed

    def parts(self, gaussians: int = ROOM_GAUSSIANS, sh_degree: int = 0) -> Iterator[GaussianMap]:
        """Yield room after room, each with its part of the corridor, of so many Gaussians."""
        return (self.part(room, gaussians, sh_degree) for room in range(self.rooms))

    def part(self, room: int, gaussians: int = ROOM_GAUSSIANS, sh_degree: int = 0) -> GaussianMap:
        """Return one room with its part of the corridor."""
        rng = np.random.default_rng([self._seed, room])
        corner, outside = self._corners(room)
        corridor = np.stack([outside, outside + _CORRIDOR])
        boxes = [np.stack([corner, corner + _ROOM]), corridor, *self._furniture(corner, rng)]
        # Between the two halves of the corridor, along it, and between the room and it.
        along = corridor + _ENDS
        across = corridor.copy()
        across[:, 1] = _MIDDLE - 0.1, _MIDDLE + 0.1
        doors = np.array([along, across, self._door(room, corner)])
        return cover_boxes(np.array(boxes), doors, gaussians, rng, sh_degree)

    def storey(self, number: int, gaussians: int = ROOM_GAUSSIANS, sh_degree: int = 0) -> GaussianMap:
        """Return all rooms of a storey, so many Gaussians each, as one map."""
        rooms = range(number * ROOMS_OF_A_STOREY, min((number + 1) * ROOMS_OF_A_STOREY, self.rooms))
        parts = [self.part(room, gaussians, sh_degree) for room in rooms]
        return GaussianMap(
            means=np.concatenate([part.means for part in parts]),
            scales=np.concatenate([part.scales for part in parts]),
            rotations=np.concatenate([part.rotations for part in parts]),
            opacities=np.concatenate([part.opacities for part in parts]),
            sh=np.concatenate([part.sh for part in parts]),
        )

    def pose(self, room: int, seed: int) -> np.ndarray:
        """Return a pose (4, 4) T_map_camera of a camera in a room that looks across it."""
        rng = np.random.default_rng([self._seed, room, seed])
        corner, _ = self._corners(room)
        side = rng.integers(2, size=2)
        position = corner + np.append(np.where(side, _ROOM[:2] - 0.5, 0.5) + rng.uniform(-0.3, 0.3, 2), _EYES)
        target = corner + np.append(np.where(side, 0.3, 0.7) * _ROOM[:2], rng.uniform(0.6, 1.2))
        return looking_at(tuple(position), tuple(target))

    def corridor_pose(self) -> np.ndarray:
        """Return a pose (4, 4) T_map_camera in the first corridor, along it and through the whole building."""
        return looking_at((0.5, _MIDDLE, _EYES), (10.0, _MIDDLE, 1.3))

    def _corners(self, room: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest corners (3,) of a room and of its part of the corridor."""
        storey, place = divmod(room, ROOMS_OF_A_STOREY)
        x, z = place // 2 * _ROOM[0], storey * _STOREY
        if place % 2:
            return np.array([x, _ROOM[1] + 2 * _CORRIDOR[1], z]), np.array([x, _MIDDLE, z])
        return np.array([x, 0.0, z]), np.array([x, _ROOM[1], z])

    def _door(self, room: int, corner: np.ndarray) -> list[np.ndarray]:
        """Return the corners of a room's door."""
        y = corner[1] + (0.0 if room % 2 else _ROOM[1])
        x = corner[0] + 0.5 * (_ROOM[0] - _DOOR_WIDTH)
        return [np.array([x, y - 0.1, corner[2]]), np.array([x + _DOOR_WIDTH, y + 0.1, corner[2] + _DOOR_HEIGHT])]

    def _furniture(self, corner: np.ndarray, rng: np.random.Generator) -> Iterator[np.ndarray]:
        """Yield the corners (2, 3) of what stands in a room, away from where cameras are."""
        for _ in range(rng.integers(*_PIECES)):
            size = rng.uniform(_SMALLEST, _LARGEST)
            place = corner + np.append(rng.uniform(1.2, _ROOM[:2] - 1.2 - 0.5 * size[:2]), 0.0)
            yield np.stack([place, place + size])
