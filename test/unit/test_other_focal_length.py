"""Another focal length, told by matches that are far off with the calibrated one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose, rotation_error_deg, so3_exp, transform, translation_error
from gsfeatloc_ros.pose.other_focal_length import STEP_SIGMA, other_focal_lengths
from gsfeatloc_ros.pose.solve import Correspondences, PoseOptions, reprojection_errors

CAMERA = Camera(320, 240, np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]]))
POSE = make_pose(so3_exp(np.array([0.2, -0.6, 0.1])), np.array([1.0, 0.5, -2.0]))
OPTIONS = PoseOptions(max_reprojection_error=1.5)


def anywhere(pose: np.ndarray) -> bool:
    return True


def seen(error: float, wrong: int, seed: int = 0) -> Correspondences:
    """120 matches of a deep scene, seen through a focal length that is off, and `wrong` ones that agree on nothing."""
    rng = np.random.default_rng(seed)
    slopes = rng.uniform([-0.5, -0.38], [0.5, 0.38], (120 + wrong, 2))
    points = transform(POSE, np.column_stack([slopes, np.ones(len(slopes))]) * rng.uniform(1.5, 8, (len(slopes), 1)))
    pixels = (1 + error) * 300 * slopes + [159.5, 119.5] + 0.3 * rng.normal(size=slopes.shape)
    pixels[120:] = rng.uniform([0, 0], [319, 239], (wrong, 2))
    return Correspondences(pixels, points, np.zeros_like(points))


def told(found: Correspondences, plausible=anywhere) -> float:
    """How much longer the focal length is that explains most matches, of those that are named; 0 for as calibrated."""
    most, best = explained(CAMERA, POSE, found), 0.0
    for other in other_focal_lengths(CAMERA, POSE, found, OPTIONS, plausible):
        if (count := explained(CAMERA.zoomed(other.error), other.T_map_camera, found)) > most:
            most, best = count, other.error
    return best


def explained(camera: Camera, pose: np.ndarray, found: Correspondences) -> int:
    return int((reprojection_errors(camera, pose, found) <= OPTIONS.max_reprojection_error).sum())


@pytest.mark.parametrize("error", [-0.1, -0.06, 0.06, 0.1])
def test_a_focal_length_that_is_far_off_is_told(error: float) -> None:
    found = seen(error, wrong=60)
    assert told(found) == pytest.approx(error, abs=1.6 * STEP_SIGMA)
    others = other_focal_lengths(CAMERA, POSE, found, OPTIONS, anywhere)
    nearest = min(others, key=lambda other: abs(other.error - error))
    assert translation_error(nearest.T_map_camera, POSE) < 0.3
    assert rotation_error_deg(nearest.T_map_camera, POSE) < 1.0


@pytest.mark.parametrize("wrong", [0, 60, 200])
@pytest.mark.parametrize("error", [0.0, 0.01])
def test_a_right_one_is_left_alone(error: float, wrong: int) -> None:
    """Also where most of the matches agree on nothing, as where the photo is covered."""
    assert told(seen(error, wrong)) == 0.0
    named = [other.error for other in other_focal_lengths(CAMERA, POSE, seen(error, wrong), OPTIONS, anywhere)]
    assert named == [] or (error, named) == (0.01, [0.04])


def test_of_a_plane_seen_from_the_front_any_might_be_right() -> None:
    found = seen(0.0, wrong=0)
    off = transform(invert(POSE), found.points)
    flat = transform(POSE, 3.0 * off / off[:, 2:])
    assert len(other_focal_lengths(CAMERA, POSE, replace(found, points=flat), OPTIONS, anywhere)) == 6


def test_what_agrees_elsewhere_says_nothing() -> None:
    """A picture of the place, seen through a longer lens, where the prior excludes that the camera is."""
    ring, picture = seen(0.0, wrong=0).select(np.arange(50)), seen(0.08, wrong=0, seed=1)
    moved = transform(make_pose(so3_exp(np.array([0, 0, 3.0])), np.array([20.0, 0, 0])), picture.points)
    found = Correspondences.concatenated([ring, replace(picture, points=moved)])

    def near(pose: np.ndarray) -> bool:
        return bool(np.linalg.norm(pose[:3, 3] - POSE[:3, 3]) < 2)

    assert other_focal_lengths(CAMERA, POSE, found, OPTIONS, near) == []
    assert told(found) == pytest.approx(0.08)


@pytest.mark.parametrize("count", [0, 3, 9])
def test_a_few_matches_say_nothing(count: int) -> None:
    few = seen(0.08, wrong=0).select(np.arange(count))
    assert other_focal_lengths(CAMERA, POSE, few, OPTIONS, anywhere) == []
