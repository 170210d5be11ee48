"""The similarity between two sets of poses in closed form.

Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991. Orientations
enter the same singular value decomposition: that of a pose counts like points at an arm's length from it.
"""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.align.pairs import Pairs
from gsfeatloc_ros.maps.similarity import Similarity

# Metres. An error of the orientation counts as this much times its sine: 1 cm is as bad as half a degree.
ARM = 1.0
# Map units. Cameras nearer to each other than this stand in one place.
_ONE_PLACE = 1e-12


def umeyama(pairs: Pairs) -> Similarity | None:
    """Return S_robot_map, least squares over all pairs; None where all cameras stand in one place.

    Of pairs whose orientations are not known, on a line, the turn about the line is any.
    """
    p_map, p_robot = pairs.answers[:, :3, 3], pairs.references[:, :3, 3]
    centre_map, centre_robot = p_map.mean(axis=0), p_robot.mean(axis=0)
    from_map, from_robot = p_map - centre_map, p_robot - centre_robot
    spread_map, spread_robot = np.linalg.norm(from_map), np.linalg.norm(from_robot)
    if spread_map < _ONE_PLACE or spread_robot < _ONE_PLACE:
        return None
    cross = (spread_robot / spread_map) * from_robot.T @ from_map
    if pairs.oriented:
        cross += ARM**2 * np.einsum("nij,nkj->ik", pairs.references[:, :3, :3], pairs.answers[:, :3, :3])
    U, _, Vt = np.linalg.svd(cross)
    rotation = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    scale = float(np.sum(from_robot * (from_map @ rotation.T)) / spread_map**2)
    if scale <= 0:
        return None
    return Similarity(scale, rotation, centre_robot - scale * rotation @ centre_map)
