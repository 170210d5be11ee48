"""How the priors of an evaluation are made from the true poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.evaluate.scene import Scene
from gsfeatloc_ros.geometry import make_pose, random_unit_vector, so3_exp

# Square root of the 95 % quantile of the chi-square distribution with 3 degrees of freedom: the published bounds below
# are taken as the radius of the ball that holds 95 % of an isotropic 3D normal distribution.
_QUANTILE_95 = 2.7955


@dataclass(frozen=True)
class PriorError:
    """Standard deviations of a prior's error: rotation in radians, translation in map units."""

    rotation: float
    translation: float


def trajectory_radius(scene: Scene) -> float:
    """Mean distance of the camera centres of all frames from their centroid, in map units."""
    centres = scene.trajectory[:, :3, 3]
    return float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())


def paper_prior_error(scene: Scene, sigma: float) -> PriorError:
    """Prior error of the published evaluation of GSFeatLoc, scaled by `sigma`.

    The view of a prior may move by half of the field of view and a quarter more:
    dtheta = FOV_x / 2 + atan(1 / 4), dp = R (tan(FOV_x / 2) + 1 / 4), with R the radius of the trajectory.
    """
    half_fov = 0.5 * scene.camera.fov_x
    return PriorError(
        rotation=sigma * (half_fov + math.atan(0.25)) / _QUANTILE_95,
        translation=sigma * trajectory_radius(scene) * (math.tan(half_fov) + 0.25) / _QUANTILE_95,
    )


def perturb(T_map_camera: np.ndarray, error: PriorError, rng: np.random.Generator) -> np.ndarray:
    """Draw a prior (4, 4) near a true pose.

    The camera is moved along a uniformly random direction by a normally distributed distance, then turned about a
    uniformly random axis by a normally distributed angle, both in its own frame.
    """
    translation = rng.normal(0.0, error.translation) * random_unit_vector(rng)
    rotation = so3_exp(rng.normal(0.0, error.rotation) * random_unit_vector(rng))
    return T_map_camera @ make_pose(np.eye(3), translation) @ make_pose(rotation, np.zeros(3))


def make_priors(scene: Scene, error: PriorError, seed: int) -> list[np.ndarray]:
    """Draw the priors (4, 4) of all photos; that of one photo does not depend on the others."""
    return [
        perturb(photo.T_map_camera, error, np.random.default_rng([seed, index]))
        for index, photo in enumerate(scene.photos)
    ]


PROTOCOLS: dict[str, Callable[[Scene, float], PriorError]] = {"paper": paper_prior_error}
