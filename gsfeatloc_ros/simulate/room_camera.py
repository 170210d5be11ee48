"""A camera whose photos are distorted, blurred by motion, noisy, and of drifting exposure, like those of a real one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.simulate.room import Room, pixel_rays

# Offsets in pixels of the ray of each moment of the exposure: five, none in the row or column of another.
_SUBPIXEL_OFFSETS = ((0.0, 0.0), (-0.4, 0.2), (0.2, 0.4), (0.4, -0.2), (-0.2, -0.4))
# Seconds that the shutter is open.
_EXPOSURE_TIME = 0.01
_GAMMA = 2.2
# Electrons of a white pixel, and the standard deviation of the noise of reading it.
_FULL_WELL = 4000.0
_READ_NOISE = 6.0
# Standard deviations of the logarithms of the exposure and of the gain of each colour, from photo to photo.
_EXPOSURE_SIGMA = 0.15
_WHITE_BALANCE_SIGMA = 0.03


class RoomCamera:
    """A camera in a room: takes photos through the lens of `camera`."""

    def __init__(self, room: Room, camera: Camera) -> None:
        self._room = room
        self._rays = [pixel_rays(camera, offset) for offset in _SUBPIXEL_OFFSETS]
        centre = self._rays[0]
        # A lens gathers light with the fourth power of the cosine of the angle from its axis.
        self._vignetting = (np.einsum("ijk,ijk->ij", centre, centre) ** -2.0)[:, :, None]

    def photo(self, pose_at: Callable[[float], np.ndarray], time: float, rng: np.random.Generator) -> np.ndarray:
        """Return the photo (H, W, 3) uint8 RGB of an exposure centred at `time` in seconds.

        `pose_at` returns T_map_camera (4, 4) at a time. Each moment of the exposure also has its own sub-pixel offset,
        which smooths edges at no extra cost.
        """
        moments = time + _EXPOSURE_TIME * ((np.arange(len(self._rays)) + 0.5) / len(self._rays) - 0.5)
        # The middle of the pixel is seen in the middle of the exposure.
        order = (1, 3, 0, 2, 4)
        seen = [
            self._room.cast(self._rays[index], pose_at(moment))[0] for index, moment in zip(order, moments, strict=True)
        ]
        light = np.mean(seen, axis=0) ** _GAMMA * self._vignetting
        light *= np.exp(rng.normal(0, _EXPOSURE_SIGMA) + rng.normal(0, _WHITE_BALANCE_SIGMA, 3))
        return _develop(light, rng)


def _develop(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Expose a sensor to `light` (H, W, 3), 1 for white: photon and read noise, saturation, gamma and 8 bits."""
    electrons = _FULL_WELL * light
    noise = rng.standard_normal(light.shape, dtype=np.float32) * np.sqrt(electrons + _READ_NOISE**2)
    level = np.clip((electrons + noise) / _FULL_WELL, 0, 1)
    return np.rint(255 * level ** (1 / _GAMMA)).astype(np.uint8)
