"""Poses that a covariance leaves open, by what moves in the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose, moved, so3_exp, so3_log, transform
from gsfeatloc_ros.localize.left_open import picture_shift, poses_left_open
from gsfeatloc_ros.pose.lift import LiftOptions, lift
from gsfeatloc_ros.render import create_renderer

WIDE = np.diag([0.03, 0.002, 0.002, 0.0005, 0.02, 0.0005]) ** 2


@pytest.fixture(scope="module")
def view(room_map, room_camera, room_photos):
    """The camera without distortion, the render at a photo's pose, and that pose."""
    camera, pose = Camera(room_camera.width, room_camera.height, room_camera.K), room_photos[0].T_map_camera
    return camera, create_renderer(room_map).render(camera, pose), pose


def test_a_pose_that_is_known_well_leaves_none_open(view) -> None:
    camera, render, pose = view
    assert poses_left_open(camera, render, pose, 1e-3 * WIDE, LiftOptions()) == []
    assert len(poses_left_open(camera, render, pose, WIDE, LiftOptions())) == 2


def test_they_lie_two_standard_deviations_to_either_side(view) -> None:
    camera, render, pose = view
    steps = [step_to(pose, other) for other in poses_left_open(camera, render, pose, WIDE, LiftOptions())]
    for step in steps:
        assert np.sqrt(step @ np.linalg.solve(WIDE, step)) == pytest.approx(2.0)
    np.testing.assert_allclose(steps[0], -steps[1], atol=1e-9)


def test_no_other_pose_as_likely_moves_the_picture_more(view) -> None:
    camera, render, pose = view
    grid = np.stack(np.meshgrid(np.linspace(0, 639, 16), np.linspace(0, 479, 12)), axis=-1).reshape(-1, 2)
    lifted = lift(render, camera, pose, grid, LiftOptions())
    points = lifted.points[lifted.valid]

    def shift(other: np.ndarray) -> float:
        here, there = (camera.project(transform(invert(T), points)) for T in (pose, other))
        return float(np.sqrt(((here - there) ** 2).sum(axis=1).mean()))

    directions = np.random.default_rng(0).normal(size=(300, 6))
    steps = 2 * np.sqrt(np.diag(WIDE)) * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    most = min(shift(other) for other in poses_left_open(camera, render, pose, WIDE, LiftOptions()))
    assert 0.6 * most < max(shift(moved(pose, step)) for step in steps) < 1.05 * most


def test_a_map_that_shows_nothing_leaves_none_open(view) -> None:
    camera, render, pose = view
    nothing = replace(render, alpha=np.zeros_like(render.alpha), median_depth=np.full_like(render.depth, np.nan))
    assert poses_left_open(camera, nothing, pose, WIDE, LiftOptions()) == []
    assert picture_shift(camera, nothing, pose, pose, LiftOptions()) == np.inf


def test_the_picture_moves_by_what_a_turn_is_in_pixels(view) -> None:
    camera, render, pose = view
    assert picture_shift(camera, render, pose, pose, LiftOptions()) == pytest.approx(0, abs=1e-6)
    for angle in (0.002, -0.01):
        turned = pose @ make_pose(so3_exp(np.array([0, angle, 0])), np.zeros(3))
        shift = picture_shift(camera, render, pose, turned, LiftOptions())
        # Off the axis pixels are smaller: by up to 1 / cos^2 of the angle to it.
        assert abs(angle) * camera.K[0, 0] <= shift <= 1.5 * abs(angle) * camera.K[0, 0]


def test_nothing_is_seen_by_who_looks_the_other_way(view) -> None:
    camera, render, pose = view
    away = pose @ make_pose(so3_exp(np.array([0, np.pi, 0])), np.zeros(3))
    assert picture_shift(camera, render, pose, away, LiftOptions()) == np.inf


def step_to(pose: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.concatenate([other[:3, 3] - pose[:3, 3], so3_log(other[:3, :3] @ pose[:3, :3].T)])
