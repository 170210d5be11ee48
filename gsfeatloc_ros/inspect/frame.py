"""The parameters of a map that would set it upright, with its floor at z = 0."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.geometry import quaternion_from_matrix, so3_exp
from gsfeatloc_ros.inspect.upright import Upright
from gsfeatloc_ros.maps.similarity import Similarity

_UP = np.array([0.0, 0.0, 1.0])


def upright_parameters(upright: Upright, S_map_file: Similarity) -> dict[str, list[float]]:
    """Return map.rotation and map.translation that turn up to z the shortest way, and the floor, if any, to z = 0.

    Args:
        upright: where up is in the map frame.
        S_map_file: where the frame of the file lies in it, with which it was found.
    """
    up = np.array(upright.up)
    axis = np.cross(up, _UP)
    sine = float(np.linalg.norm(axis))
    # Upside down, any half turn about a level axis does.
    axis = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
    turn = Similarity(rotation=so3_exp(np.arctan2(sine, float(up @ _UP)) * axis))
    lowered = Similarity(translation=np.array([0.0, 0.0, -(upright.floor or 0.0)]))
    placed = lowered @ turn @ S_map_file
    return {
        "map.rotation": [round(value, 6) for value in quaternion_from_matrix(placed.rotation).tolist()],
        "map.translation": [round(value, 6) for value in placed.translation.tolist()],
    }
