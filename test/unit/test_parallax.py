"""How far away is what is seen, by parallax: against exact geometry, and in a room full of haze."""

from __future__ import annotations

from dataclasses import replace

import cv2
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
from gsfeatloc_ros.match.corners import find_corners
from gsfeatloc_ros.pose.lift import LiftOptions, lift
from gsfeatloc_ros.pose.parallax import lift_by_parallax, lifting, step_aside
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


def render_of(depth: float, spread: float) -> Render:
    full = np.ones((48, 64), np.float32)
    return Render(np.zeros((48, 64, 3), np.float32), depth * full, depth * full, spread * full, full)


def test_it_steps_aside_where_half_of_the_depths_are_scattered() -> None:
    assert step_aside(render_of(4.0, 0.9), CAMERA, MAX_SCATTER) == 0.0
    step = step_aside(render_of(4.0, 1.1), CAMERA, MAX_SCATTER)
    pixels = np.array([[0.0, 0.0], [63.0, 47.0], [20.4, 30.6]])
    points = transform(POSE, CAMERA.rays(pixels) * 4.0)
    np.testing.assert_allclose(seen_aside(points, POSE, step), pixels - [12.0, 0.0], atol=1e-9)
    a_third = render_of(4.0, 0.9)
    a_third.depth_std[:16] = 3.0
    assert step_aside(a_third, CAMERA, MAX_SCATTER) == 0.0
    assert step_aside(render_of(4.0, 3.0), CAMERA, float("inf")) == 0.0


def test_without_depths_it_stays() -> None:
    assert step_aside(render_of(np.nan, np.nan), CAMERA, MAX_SCATTER) == 0.0
    a_part = render_of(np.nan, np.nan)
    a_part.median_depth[:16], a_part.depth_std[:16] = 2.0, 1.0
    assert step_aside(a_part, CAMERA, MAX_SCATTER) == pytest.approx(12.0 * 2.0 / CAMERA.K[0, 0])


def test_where_nothing_is_there_is_nothing_to_lift() -> None:
    none = np.empty((0, 2))
    assert lift_by_parallax(CAMERA, POSE, none, none, 0.3).points.shape == (0, 3)


@pytest.mark.parametrize(("max_scatter", "least", "most"), [(MAX_SCATTER, 0.9, 1.0), (float("inf"), 0.0, 0.1)])
def test_lifts_what_is_behind_haze_to_where_it_is(room_map, room_camera, room_photos, max_scatter, least, most) -> None:
    """By the map's depths hardly any corner is."""
    pinhole, pose = room_camera.pinhole(), room_photos[0].T_map_camera
    clear, hidden = create_renderer(room_map), create_renderer(hazy(room_map, pinhole, pose))
    view, hazy_view = (renderer.render(pinhole, pose) for renderer in (clear, hidden))
    pixels = find_corners(cv2.cvtColor(view.image(), cv2.COLOR_RGB2GRAY), 300).astype(float)
    truth = lift(view, pinhole, pose, pixels, LiftOptions())
    lifted = lifting(hidden, hazy_view, pinhole, pose, LiftOptions(max_scatter=max_scatter))(pixels)
    depths, seen = ((each.points[truth.valid] - pose[:3, 3]) @ pose[:3, 2] for each in (truth, lifted))
    is_right = np.abs(seen / depths - 1) < 0.1
    assert least <= is_right.mean() <= most


def test_by_the_depths_where_they_can_be_trusted(room_map, room_camera, room_photos) -> None:
    pinhole, pose = room_camera.pinhole(), room_photos[0].T_map_camera
    renderer = create_renderer(room_map)
    render = renderer.render(pinhole, pose)
    pixels = np.array([[100.0, 80.0], [200.4, 90.6]])
    by_depth = lift(render, pinhole, pose, pixels, LiftOptions())
    lifted = lifting(renderer, render, pinhole, pose, LiftOptions())(pixels)
    np.testing.assert_array_equal(lifted.points, by_depth.points)


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
