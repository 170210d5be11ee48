"""Priors of an evaluation, made from the true poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.geometry import make_pose, random_unit_vector, so3_exp
from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.ros_io.prior import PriorPolicy

# Square root of the 95 % quantile of the chi-square distribution with 3 degrees of freedom: the published bounds below
# are taken as the radius of the ball that holds 95 % of an isotropic 3D normal distribution.
_QUANTILE_95 = 2.7955
_SWEEP_STEPS = 10
_CHEN_REPETITIONS = 5
_CHEN_ROTATION_DEG = (10.0, 40.0)
_CHEN_TRANSLATION = (0.0, 0.2)  # of the trajectory's radius
_NEAR_MISS_ROTATION_DEG = (5.0, 20.0)
_NEAR_MISS_TRANSLATION = (0.1, 0.5)  # of the trajectory's radius


@dataclass(frozen=True, eq=False)
class PhotoPrior:
    """A wrong pose from which a photo is localized.

    Attributes:
        photo: index of the photo in its scene.
        step: number of the prior among the photo's: the repetition, or the step of a sweep.
        T_map_camera: (4, 4) the pose.
        covariance: (6, 6) of the protocol's errors, as one knows it of a prior in practice: x y z and rotation about
            x y z, axes of the map frame, map units and radians; None if it is not known.
        given: whether the localizer is told of it; otherwise it only says how far off one is who knows nothing.
    """

    photo: int
    step: int
    T_map_camera: np.ndarray
    covariance: np.ndarray | None = None
    given: bool = True


@dataclass(frozen=True)
class PriorError:
    """Standard deviations of a prior's error along a random direction: in radians and in map units."""

    rotation: float
    translation: float

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (6, 6) of translation and rotation vector, the same in all axes as all directions are alike."""
        return np.diag(np.repeat(np.square([self.translation, self.rotation]) / 3, 3))


def trajectory_radius(scene: Scene) -> float:
    """Return the mean distance of the camera centres of all frames from their centroid, in map units."""
    centres = scene.trajectory[:, :3, 3]
    return float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())


def paper_bounds(scene: Scene) -> tuple[float, float]:
    """Return the largest prior errors of the published evaluation of GSFeatLoc: radians and map units.

    The view of a prior may move by half of the field of view and a quarter more:
    dtheta = FOV_x / 2 + atan(1 / 4), dp = R (tan(FOV_x / 2) + 1 / 4), with R the radius of the trajectory.
    """
    half_fov = 0.5 * scene.camera.fov_x
    return half_fov + math.atan(0.25), trajectory_radius(scene) * (math.tan(half_fov) + 0.25)


def paper_prior_error(scene: Scene, sigma: float) -> PriorError:
    """Return the published evaluation's prior error, scaled by `sigma`: 95 % are within `paper_bounds`."""
    rotation, translation = paper_bounds(scene)
    return PriorError(sigma * rotation / _QUANTILE_95, sigma * translation / _QUANTILE_95)


def perturb(T_map_camera: np.ndarray, error: PriorError, rng: np.random.Generator) -> np.ndarray:
    """Draw a prior (4, 4) near a true pose.

    The camera is moved along a uniformly random direction by a normally distributed distance, then turned about a
    uniformly random axis by a normally distributed angle, both in its own frame.
    """
    translation = rng.normal(0.0, error.translation) * random_unit_vector(rng)
    rotation = rng.normal(0.0, error.rotation) * random_unit_vector(rng)
    return _moved(T_map_camera, rotation, translation)


def make_priors(scene: Scene, error: PriorError, seed: int) -> list[np.ndarray]:
    """Draw the priors (4, 4) of all photos; that of one photo does not depend on the others."""
    return [
        perturb(photo.T_map_camera, error, np.random.default_rng([seed, index]))
        for index, photo in enumerate(scene.photos)
    ]


def paper(scene: Scene, sigma: float, seed: int) -> list[PhotoPrior]:
    """Draw priors as in the published evaluation of GSFeatLoc: one normally distributed, see `paper_prior_error`."""
    error = paper_prior_error(scene, sigma)
    return [PhotoPrior(index, 0, pose, error.covariance) for index, pose in enumerate(make_priors(scene, error, seed))]


def chen(scene: Scene, sigma: float, seed: int) -> list[PhotoPrior]:
    """Draw five priors a photo, moved by 0 to 0.2 radii and turned by 10 to 40 degrees, in random directions.

    Distances and angles are uniformly distributed; `sigma` scales them.
    """
    return _uniform(scene, sigma, seed, _Ranges(_CHEN_ROTATION_DEG, _CHEN_TRANSLATION, _CHEN_REPETITIONS))


def near_miss(scene: Scene, sigma: float, seed: int) -> list[PhotoPrior]:
    """Draw one prior a photo as `chen` does, but moved by 0.1 to 0.5 radii and turned by 5 to 20 degrees.

    From there much of the photo is in view, from the wrong side: a pose near the prior must not be believed.
    """
    return _uniform(scene, sigma, seed, _Ranges(_NEAR_MISS_ROTATION_DEG, _NEAR_MISS_TRANSLATION, 1))


def kidnapped(scene: Scene, sigma: float, seed: int) -> list[PhotoPrior]:
    """Draw the pose of a random other photo for each, with the covariance of `paper`: the camera was carried away."""
    covariance = paper_prior_error(scene, sigma).covariance
    return [PhotoPrior(index, 0, pose, covariance) for index, pose in enumerate(_poses_of_others(scene, seed))]


def no_prior(scene: Scene, sigma: float, seed: int) -> list[PhotoPrior]:
    """Give no prior; one who guesses is as far off as another photo."""
    return [PhotoPrior(index, 0, pose, given=False) for index, pose in enumerate(_poses_of_others(scene, seed))]


def planar(scene: Scene, sigma: float, seed: int) -> list[PhotoPrior]:
    """Know what the node's `search.planar` knows, height and tilt; x, y and the turn about z are of a random other.

    Height and tilt are off by the standard deviations of that prior, times `sigma`.
    """
    plane = PriorPolicy().plane()
    assert plane.covariance is not None
    known = sigma * np.sqrt(plane.covariance.diagonal())[[2, 3, 4]]
    covariance = plane.covariance.copy()
    covariance[[2, 3, 4], [2, 3, 4]] = np.square(known)
    priors = []
    for index, (photo, other) in enumerate(zip(scene.photos, _poses_of_others(scene, seed), strict=True)):
        rng = np.random.default_rng([seed, index])
        height, *tilt = known * rng.normal(size=3)
        turn = rng.uniform(0.0, 2.0 * math.pi)
        rotation = so3_exp(np.array([0.0, 0.0, turn])) @ so3_exp(np.array([*tilt, 0.0])) @ photo.T_map_camera[:3, :3]
        position = [*other[:2, 3], photo.T_map_camera[2, 3] + height]
        priors.append(PhotoPrior(index, 0, make_pose(rotation, position), covariance))
    return priors


def sweep_rotation(scene: Scene, sigma: float, seed: int) -> list[PhotoPrior]:
    """Pan every photo to the right by 0 to `sigma` times the rotation of `paper_bounds`, in ten steps."""
    angles = _steps(sigma * paper_bounds(scene)[0])
    return _sweep(scene, sigma, [(np.array([0.0, angle, 0.0]), np.zeros(3)) for angle in angles])


def sweep_translation(scene: Scene, sigma: float, seed: int) -> list[PhotoPrior]:
    """Move every photo to the right by 0 to `sigma` times the translation of `paper_bounds`, in ten steps."""
    distances = _steps(sigma * paper_bounds(scene)[1])
    return _sweep(scene, sigma, [(np.zeros(3), np.array([distance, 0.0, 0.0])) for distance in distances])


PROTOCOLS: dict[str, Callable[[Scene, float, int], list[PhotoPrior]]] = {
    "paper": paper,
    "chen": chen,
    "near-miss": near_miss,
    "kidnapped": kidnapped,
    "no-prior": no_prior,
    "planar": planar,
    "sweep-rotation": sweep_rotation,
    "sweep-translation": sweep_translation,
}
WITHOUT_PRIOR = ("kidnapped", "no-prior", "planar")
"""Those in which no view near the prior shows the photo."""
SWEEPS = ("sweep-rotation", "sweep-translation")


@dataclass(frozen=True)
class _Ranges:
    """Ranges of uniformly distributed errors, in degrees and in radii of the trajectory, and the priors a photo."""

    rotation_deg: tuple[float, float]
    translation: tuple[float, float]
    repetitions: int


def _uniform(scene: Scene, sigma: float, seed: int, ranges: _Ranges) -> list[PhotoPrior]:
    """Draw priors of all photos, moved and turned in random directions by amounts out of ranges times `sigma`."""
    radius = trajectory_radius(scene)
    covariance = PriorError(
        sigma * np.radians(_root_mean_square(*ranges.rotation_deg)),
        sigma * radius * _root_mean_square(*ranges.translation),
    ).covariance
    priors = []
    for index, photo in enumerate(scene.photos):
        for repetition in range(ranges.repetitions):
            rng = np.random.default_rng([seed, index, repetition])
            translation = sigma * radius * rng.uniform(*ranges.translation) * random_unit_vector(rng)
            rotation = sigma * np.radians(rng.uniform(*ranges.rotation_deg)) * random_unit_vector(rng)
            priors.append(PhotoPrior(index, repetition, _moved(photo.T_map_camera, rotation, translation), covariance))
    return priors


def _poses_of_others(scene: Scene, seed: int) -> list[np.ndarray]:
    """Draw for each photo the pose (4, 4) of another, its own where there is no other."""
    count = len(scene.photos)
    steps = np.random.default_rng(seed).integers(1, max(count, 2), size=count)
    return [scene.photos[(index + step) % count].T_map_camera for index, step in enumerate(steps)]


def _steps(bound: float) -> np.ndarray:
    return np.linspace(0.0, bound, _SWEEP_STEPS + 1)


def _sweep(scene: Scene, sigma: float, moves: list[tuple[np.ndarray, np.ndarray]]) -> list[PhotoPrior]:
    """Return the priors of all photos, each moved by all `moves` (rotation vector, translation)."""
    covariance = paper_prior_error(scene, sigma).covariance
    return [
        PhotoPrior(index, step, _moved(photo.T_map_camera, *move), covariance)
        for index, photo in enumerate(scene.photos)
        for step, move in enumerate(moves)
    ]


def _root_mean_square(low: float, high: float) -> float:
    """Return the root mean square of a variable uniform between two values."""
    return math.sqrt((low * low + low * high + high * high) / 3)


def _moved(T_map_camera: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Move a pose (4, 4) by a translation (3,), then turn it by a rotation vector (3,), both in its own frame."""
    return T_map_camera @ make_pose(np.eye(3), translation) @ make_pose(so3_exp(rotation), np.zeros(3))
