"""What a rolling shutter does to the matches of a photo, where the motion of the camera is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, transform
from gsfeatloc_ros.pose.solve import Correspondences


def at_middle_row(camera: Camera, T_map_camera: np.ndarray, found: Correspondences) -> Correspondences:
    """Return the matches as if the whole photo had been taken when its middle row was.

    A point is moved to where the camera of the middle row would have seen it at the pixel at which that of the point's
    own row did. Nothing else changes: what follows solves for the pose at the middle row.

    Args:
        camera: with its motion (`readout`); without, the matches are as they were.
        T_map_camera: (4, 4) nearly the pose at the middle row: what it is off by is small beside the points' distance.
        found: correspondences. The row of an undistorted pixel is taken for that in which it was read.
    """
    if camera.readout is None:
        return found
    when = ((found.pixels[:, 1] + 0.5) / camera.height - 0.5)[:, None]
    moved, turned = when * camera.readout[:3], when * camera.readout[3:]
    shifted = transform(invert(T_map_camera), found.points) - moved
    # The inverse rotation, to second order: angles are small.
    across = np.cross(turned, shifted)
    return replace(found, points=transform(T_map_camera, shifted - across + 0.5 * np.cross(turned, across)))
