"""What many images tell of their camera: whether its focal length is that of camera_info."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.localize.evidence import Limits, verdict

# What is said of a camera is made of this many of the newest readings at most: lenses are refocused.
_MAX_READINGS = 1000
# With fewer readings nobody is warned, nor of a smaller error (relative) or one of fewer standard deviations.
_MIN_READINGS = 10
_MIN_ERROR = 0.012
_MIN_SIGMAS = 6.0
# A calibration is confirmed if, by so many of the newest readings and so many standard deviations, its focal length is
# off by no more than this share.
_CONFIRMING_READINGS = 30
_CONFIRMED_SIGMAS = 3.0
_MAX_CONFIRMED_ERROR = 0.01


@dataclass(frozen=True)
class FocalLength:
    """How much longer than calibrated a focal length is.

    Attributes:
        error: relative; NaN without readings.
        sigma: its standard deviation.
        count: number of readings that it was made of.
    """

    error: float
    sigma: float
    count: int


class CameraHealth:
    """Combines the focal lengths that fit the images of a camera.

    Readings may be taken in one thread and what they say be asked for in another.
    """

    def __init__(self) -> None:
        self._calibration: tuple[object, ...] | None = None
        self._K = np.eye(3)
        self._readings: deque[tuple[float, float]] = deque(maxlen=_MAX_READINGS)

    def take(self, camera: Camera, estimate: Estimate) -> None:
        """Take the reading of an image, if it has one to be trusted; start anew with another calibration."""
        calibration = _identity(camera)
        if calibration != self._calibration:
            self._calibration, self._readings = calibration, deque(maxlen=_MAX_READINGS)
            self._K = camera.K
        error, sigma = estimate.evidence.focal_error, estimate.evidence.focal_sigma
        if (estimate.localized or _is_refused_for_focal_length(estimate)) and np.isfinite(error) and sigma > 0:
            self._readings.append((error, sigma))

    @property
    def focal_length(self) -> FocalLength:
        """What all readings say."""
        return _mean(list(self._readings.copy()))

    def confirms(self, camera: Camera) -> bool:
        """Return whether the readings are of this calibration, and the newest show that its focal length is right."""
        focal = _mean(list(self._readings.copy())[-_CONFIRMING_READINGS:])
        if focal.count < _MIN_READINGS or _identity(camera) != self._calibration:
            return False
        return abs(focal.error) + _CONFIRMED_SIGMAS * focal.sigma <= _MAX_CONFIRMED_ERROR

    @property
    def warning(self) -> str:
        """What is wrong with the calibration, in a sentence; empty where nothing is known to be."""
        focal = self.focal_length
        if focal.count < _MIN_READINGS or not abs(focal.error) > max(_MIN_ERROR, _MIN_SIGMAS * focal.sigma):
            return ""
        fx, fy = np.diag(self._K)[:2]
        return (
            f"the focal length fits {100 * abs(focal.error):.1f} +- {100 * focal.sigma:.1f} % "
            f"{'longer' if focal.error > 0 else 'shorter'} than camera_info says, by {focal.count} answers "
            f"(fx {(1 + focal.error) * fx:.1f}, fy {(1 + focal.error) * fy:.1f}, not {fx:.1f}, {fy:.1f}): "
            "is camera_info of this stream?"
        )

    def texts(self) -> dict[str, str]:
        """Return what is known by key."""
        focal = self.focal_length
        return {
            "focal_error": f"{focal.error:.4f}",
            "focal_sigma": f"{focal.sigma:.4f}",
            "focal_answers": str(focal.count),
        }


def _mean(readings: list[tuple[float, float]]) -> FocalLength:
    """Return the weighted mean of readings; where they scatter more than they claim, its deviation is that much larger.

    Args:
        readings: errors and their standard deviations, relative.
    """
    if not readings:
        return FocalLength(float("nan"), float("nan"), 0)
    errors, sigmas = np.array(readings).T
    weights = sigmas**-2
    mean = weights @ errors / weights.sum()
    scatter = weights @ (errors - mean) ** 2 / max(len(errors) - 1, 1)
    return FocalLength(float(mean), float(np.sqrt(max(scatter, 1.0) / weights.sum())), len(errors))


def _identity(camera: Camera) -> tuple[object, ...]:
    """Return what tells one calibration from another."""
    return camera.width, camera.height, camera.model, camera.K.tobytes(), camera.distortion.tobytes()


def _is_refused_for_focal_length(estimate: Estimate) -> bool:
    """Return whether the focal length is among the reasons against a pose: they are more with it than without."""
    evidence, limits = estimate.evidence, Limits()
    return len(verdict(evidence, limits)) > len(verdict(replace(evidence, focal_error=0.0), limits))
