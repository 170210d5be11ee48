"""A made-up map of any number of Gaussians to measure on, like trained ones in what decides how long a frame takes."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.simulate.boxes import cover_boxes, looking_at

# Boxes by their lowest and highest corner, in metres, z up: two rooms with a door between them, and what stands there.
_BOXES = (
    ((0.0, 0.0, 0.0), (5.0, 4.0, 2.7)),
    ((5.0, 0.0, 0.0), (10.0, 4.0, 2.7)),
    ((1.5, 1.2, 0.0), (3.1, 2.2, 0.75)),  # a table
    ((0.1, 3.4, 0.0), (2.2, 3.9, 2.0)),  # shelves
    ((3.6, 0.1, 0.0), (4.6, 0.7, 0.9)),  # a chest
    ((6.2, 2.4, 0.0), (8.2, 3.9, 0.5)),  # a bed
    ((9.3, 0.4, 0.0), (9.9, 2.4, 2.2)),  # a wardrobe
    ((6.4, 0.2, 0.0), (7.6, 0.8, 0.8)),  # a desk
)
_DOOR = ((4.9, 1.5, 0.0), (5.1, 2.6, 2.1))

# What to measure from, T_map_camera (4, 4) by name: most of the map in view, and as on a robot's way.
VIEWS = {
    "everything": looking_at((1.2, 2.9, 2.1), (6.0, 1.8, 1.1)),
    "typical": looking_at((4.8, 3.8, 1.6), (0.8, 1.2, 0.9)),
}


def two_rooms(count: int, seed: int = 0) -> GaussianMap:
    """Cover two furnished rooms with `count` Gaussians of SH degree 3, the smaller the more there are."""
    return cover_boxes(np.array(_BOXES), np.array([_DOOR]), count, np.random.default_rng(seed))
