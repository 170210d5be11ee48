"""How far away is what is seen, by parallax: against exact geometry, and in a room full of haze."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hazes import hazy
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose, rotation_error_deg, so3_exp, transform, translation_error
from gsfeatloc_ros.evaluate.ablation import ablated_localizer
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.query import Components
from gsfeatloc_ros.match import create_matcher, create_tracker
from gsfeatloc_ros.pose.parallax import lift_as_nearest, lift_by_parallax, step_aside
from gsfeatloc_ros.render import Render, create_renderer

CAMERA = Camera(64, 48, np.array([[60.0, 0, 31], [0, 61.0, 25], [0, 0, 1]]))
POSE = make_pose(so3_exp(np.array([0.4, -1.1, 0.3])), np.array([2.0, -1.0, 0.5]))
ROTATIONS = st.tuples(*[st.floats(-3, 3)] * 3).map(lambda vector: so3_exp(np.array(vector)))
MAX_SCATTER = 0.25


def seen_aside(points: np.ndarray, pose: np.ndarray, step: float) -> np.ndarray:
    """Where CAMERA sees points (N, 3) from a step to the right of a pose."""
    aside = pose.copy()
    aside[:3, 3] += step * pose[:3, 0]
    return CAMERA.project(transform(invert(aside), points))


@given(ROTATIONS, st.floats(0, 63), st.floats(0, 47), st.floats(0.5, 50), st.floats(2, 30))
def test_lifts_what_moves_to_where_it_is(rotation, x: float, y: float, depth: float, shift: float) -> None:
    pose = make_pose(rotation, np.array([1.0, 2.0, 3.0]))
    pixels = np.array([[x, y]])
    points = transform(pose, CAMERA.rays(pixels) * depth)
    step = shift * depth / CAMERA.K[0, 0]
    lifted = lift_by_parallax(CAMERA, pose, pixels, seen_aside(points, pose, step), step)
    assert lifted.valid.all()
    np.testing.assert_allclose(lifted.points, points, rtol=1e-6, atol=1e-6 * depth)


def test_the_uncertainty_is_that_of_a_quarter_of_a_pixel_along_the_ray() -> None:
    pixels = np.array([[10.0, 40.0], [50.0, 5.0]])
    aside = pixels - [[10.0, 0.0], [4.0, 0.0]]
    here, farther = (
        lift_by_parallax(CAMERA, POSE, pixels, aside + np.array([moved, 0.0]), 0.3) for moved in (0.0, 0.001)
    )
    np.testing.assert_allclose(here.sigmas, (farther.points - here.points) * 250, rtol=1e-3)


@pytest.mark.parametrize("moved", [(0.0, 0.0), (5.0, 0.0), (-1.4, 0.0), (-9.0, 0.8), (-9.0, -0.8), (np.nan, 0.0)])
def test_what_does_not_move_along_its_row_to_the_left_is_not_lifted(moved) -> None:
    pixels = np.array([[30.0, 20.0]])
    lifted = lift_by_parallax(CAMERA, POSE, pixels, pixels + np.array(moved), 0.3)
    assert not lifted.valid.any()
    assert np.isnan(lifted.points).all()


def test_others_are_lifted_as_the_nearest_is() -> None:
    known_pixels = np.array([[10.0, 10.0], [50.0, 10.0], [30.0, 40.0]])
    depths = np.array([[2.0], [5.0], [9.0]])
    shifts = CAMERA.K[0, 0] * 0.3 / depths
    aside = known_pixels - np.hstack([shifts, [[0.0], [0.0], [3.0]]])
    known = lift_by_parallax(CAMERA, POSE, known_pixels, aside, 0.3)
    # The third was not found.
    assert known.valid.tolist() == [True, True, False]
    pixels = np.array([[12.0, 11.0], [60.0, 3.0], [31.0, 40.0]])
    lifted = lift_as_nearest(CAMERA, POSE, pixels, known_pixels, known)
    assert lifted.valid.all()
    np.testing.assert_allclose(transform(invert(POSE), lifted.points)[:, 2], [2.0, 5.0, 5.0])
    np.testing.assert_allclose(CAMERA.project(transform(invert(POSE), lifted.points)), pixels)


def test_where_nothing_is_there_is_nothing_to_lift() -> None:
    none = np.empty((0, 2))
    known = lift_by_parallax(CAMERA, POSE, none, none, 0.3)
    assert known.points.shape == (0, 3)
    assert not lift_as_nearest(CAMERA, POSE, np.array([[3.0, 4.0]]), none, known).valid.any()
    assert lift_as_nearest(CAMERA, POSE, none, none, known).points.shape == (0, 3)


def render_of(depth: float, spread: float) -> Render:
    full = np.ones((48, 64), np.float32)
    return Render(np.zeros((48, 64, 3), np.float32), depth * full, depth * full, spread * full, full)


def test_it_steps_aside_where_half_of_the_depths_are_scattered() -> None:
    pixels = np.array([[0.0, 0.0], [63.0, 47.0], [20.4, 30.6]])
    assert step_aside(render_of(4.0, 0.9), CAMERA, pixels, MAX_SCATTER) == 0.0
    step = step_aside(render_of(4.0, 1.1), CAMERA, pixels, MAX_SCATTER)
    points = transform(POSE, CAMERA.rays(pixels) * 4.0)
    np.testing.assert_allclose(seen_aside(points, POSE, step), pixels - [12.0, 0.0], atol=1e-9)
    one_of_three = render_of(4.0, 0.9)
    one_of_three.depth_std[0, 0] = 3.0
    assert step_aside(one_of_three, CAMERA, pixels, MAX_SCATTER) == 0.0
    assert step_aside(render_of(4.0, 3.0), CAMERA, pixels, float("inf")) == 0.0


def test_without_corners_or_depths_it_stays() -> None:
    assert step_aside(render_of(4.0, 3.0), CAMERA, np.empty((0, 2)), MAX_SCATTER) == 0.0
    assert step_aside(render_of(np.nan, np.nan), CAMERA, np.array([[3.0, 4.0]]), MAX_SCATTER) == 0.0
    one = render_of(np.nan, np.nan)
    one.median_depth[5, 5], one.depth_std[5, 5] = 2.0, 1.0
    step = step_aside(one, CAMERA, np.array([[3.0, 4.0], [5.0, 5.0]]), MAX_SCATTER)
    assert step == pytest.approx(12.0 * 2.0 / CAMERA.K[0, 0])


@pytest.mark.parametrize("number", range(4))
def test_it_sees_through_haze(room_map, room_camera, room_photos, number: int) -> None:
    """Every depth is that of the haze, and every corner that of the room behind."""
    photo, pinhole = room_photos[number], room_camera.pinhole()
    renderer = create_renderer(hazy(room_map, pinhole, photo.T_map_camera))
    hidden, clear = (each.render(pinhole, photo.T_map_camera) for each in (renderer, create_renderer(room_map)))
    assert np.nanmean(hidden.median_depth < 0.9 * clear.median_depth) > 0.95
    matcher = create_matcher("sift")
    image, prior = photo.image, photo.T_map_camera_prior
    estimate = Localizer(renderer, matcher).localize(image, room_camera, prior)
    assert estimate.localized, estimate.reason
    assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera) < 0.5
    assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.02
    off = estimate.T_map_camera[:3, 3] - photo.T_map_camera[:3, 3]
    assert off @ np.linalg.solve(estimate.covariance[:3, :3], off) < 3 * 3.5**2
    # It is by parallax that it does.
    without = ablated_localizer(Components(renderer, matcher, create_tracker, LocalizerOptions()), "parallax")
    assert not without.localize(image, room_camera, prior).localized


def test_a_haze_that_hides_all_is_no_answer(room_map, room_camera, room_photos) -> None:
    photo = room_photos[0]
    fog = hazy(room_map, room_camera.pinhole(), photo.T_map_camera)
    fog = replace(fog, opacities=np.maximum(fog.opacities, np.float32(0.9)))
    estimate = Localizer(create_renderer(fog), create_matcher("sift")).localize(
        photo.image, room_camera, photo.T_map_camera_prior
    )
    assert not estimate.localized
