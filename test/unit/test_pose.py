"""Lifting and solving against exact scenes, finite differences and Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import (
    invert,
    make_pose,
    moved,
    rotation_error_deg,
    so3_exp,
    so3_log,
    transform,
    translation_error,
)
from gsfeatloc_ros.pose.descent import descend
from gsfeatloc_ros.pose.lift import DEPTH_SIGMA_PER_STD, MAX_DEPTH_STD, LiftOptions, lift
from gsfeatloc_ros.pose.linear import linearize, normal_equations
from gsfeatloc_ros.pose.solve import (
    MIN_POINTS,
    Correspondences,
    PoseOptions,
    refine_pose,
    reprojection_errors,
    solve_near,
    solve_pose,
)
from gsfeatloc_ros.render.base import Render

CAMERA = Camera(640, 480, np.array([[600.0, 0, 315], [0, 610.0, 245], [0, 0, 1]]))
POSE = make_pose(so3_exp(np.array([0.4, -1.1, 0.3])), np.array([2.0, -1.0, 0.5]))


def plane_render(width: int = 40, height: int = 30) -> Render:
    """A plane whose depth grows by 0.01 a column and 0.02 a row, from 2."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    depth = 2 + 0.01 * x + 0.02 * y
    full = np.ones_like(depth)
    return Render(np.zeros((height, width, 3), np.float32), depth, depth.copy(), 0.01 * full, full)


def small_camera(width: int = 40, height: int = 30) -> Camera:
    return Camera(width, height, np.array([[50.0, 0, 19], [0, 52.0, 15], [0, 0, 1]]))


@given(st.floats(0, 39), st.floats(0, 29))
def test_lifts_at_subpixel_positions(x: float, y: float) -> None:
    pixels = np.array([[x, y]])
    lifted = lift(plane_render(), small_camera(), POSE, pixels, LiftOptions())
    assert lifted.valid.all()
    in_camera = transform(invert(POSE), lifted.points)
    np.testing.assert_allclose(in_camera[0, 2], 2 + 0.01 * x + 0.02 * y, rtol=1e-6)
    np.testing.assert_allclose(small_camera().project(in_camera), pixels, atol=1e-6)


def test_uncertainty_lies_along_the_ray() -> None:
    pixels = np.array([[3.0, 4.0], [30.5, 20.25]])
    lifted = lift(plane_render(), small_camera(), POSE, pixels, LiftOptions())
    rays = lifted.points - POSE[:3, 3]
    cosine = (rays * lifted.sigmas).sum(1) / np.linalg.norm(rays, axis=1) / np.linalg.norm(lifted.sigmas, axis=1)
    np.testing.assert_allclose(cosine, 1.0)
    depth_sigma = (lifted.sigmas @ POSE[:3, :3])[:, 2]
    np.testing.assert_allclose(depth_sigma, DEPTH_SIGMA_PER_STD * 0.01, rtol=1e-6)


def test_a_floater_does_not_void_the_uncertainty() -> None:
    render = plane_render()
    render.depth_std[:] = 1.0
    lifted = lift(render, small_camera(), np.eye(4), np.array([[10.0, 10.0]]), LiftOptions())
    assert lifted.sigmas[0, 2] == pytest.approx(DEPTH_SIGMA_PER_STD * MAX_DEPTH_STD * 2.3)


def test_a_depth_that_may_be_that_of_a_haze_is_none() -> None:
    """Of two layers, the spread is at most half of the farther one's depth; of a haze in front, it is far more."""
    render = plane_render()
    pixel = np.array([[10.0, 10.0]])
    for spread, valid in ((0.49 * 2.3, True), (0.51 * 2.3, False)):
        render.depth_std[:] = spread
        assert lift(render, small_camera(), np.eye(4), pixel, LiftOptions()).valid[0] == valid


@pytest.mark.parametrize("pixel", [(-0.1, 5), (39.1, 5), (5, -0.1), (5, 29.1), (np.nan, 5)])
def test_pixels_outside_are_not_lifted(pixel) -> None:
    lifted = lift(plane_render(), small_camera(), POSE, np.array([pixel]), LiftOptions())
    assert not lifted.valid.any()
    assert np.isnan(lifted.points).all()


def test_refuses_edges_thin_alpha_and_missing_depth() -> None:
    render = plane_render()
    render.median_depth[:, 20:] += 1.0  # an edge between columns 19 and 20
    render.alpha[5, 5] = 0.6
    render.median_depth[10, 10] = np.nan
    pixels = np.array([[19.5, 3.0], [18.5, 3.0], [5.4, 5.4], [9.7, 9.6], [15.0, 25.0]])
    assert lift(render, small_camera(), POSE, pixels, LiftOptions()).valid.tolist() == [False, True, False, False, True]


def test_nothing_to_lift() -> None:
    lifted = lift(plane_render(), small_camera(), POSE, np.empty((0, 2)), LiftOptions())
    assert lifted.points.shape == (0, 3)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1)])
def test_lifts_from_images_one_pixel_wide_or_high(size) -> None:
    lifted = lift(plane_render(*size), small_camera(*size), POSE, np.zeros((1, 2)), LiftOptions())
    assert lifted.valid.all()


def scene(seed: int, count: int = 200, noise: float = 0.5, outliers: float = 0.0) -> tuple[Correspondences, np.ndarray]:
    """Matches seen from POSE, and which of them are outliers (N,)."""
    rng = np.random.default_rng(seed)
    in_camera = CAMERA.rays(rng.uniform([0, 0], [639, 479], (count, 2))) * rng.uniform(2, 8, (count, 1))
    pixels = CAMERA.project(in_camera) + noise * rng.normal(size=(count, 2))
    wrong = rng.random(count) < outliers
    pixels[wrong] = rng.uniform([0, 0], [639, 479], (int(wrong.sum()), 2))
    return exact(pixels, transform(POSE, in_camera)), wrong


def exact(pixels: np.ndarray, points: np.ndarray) -> Correspondences:
    """Matches whose points have no uncertainty."""
    return Correspondences(pixels, points, np.zeros_like(points))


class CountingCamera(Camera):
    """A camera that counts how often points are projected."""

    projections = 0

    def project(self, points: np.ndarray) -> np.ndarray:
        type(self).projections += 1
        return super().project(points)


def test_the_errors_of_a_pose_are_computed_once() -> None:
    found, _ = scene(0, outliers=0.3)
    solution = solve_pose(CountingCamera(CAMERA.width, CAMERA.height, CAMERA.K), found, PoseOptions(), seed=0)
    assert CountingCamera.projections == 1
    np.testing.assert_array_equal(solution.errors, reprojection_errors(CAMERA, solution.T_map_camera, found))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), outliers=st.floats(0, 0.6))
def test_finds_the_pose_among_outliers(seed: int, outliers: float) -> None:
    found, wrong = scene(seed, noise=0.5, outliers=outliers)
    solution = solve_pose(CAMERA, found, PoseOptions(), seed=0)
    assert rotation_error_deg(solution.T_map_camera, POSE) < 0.2
    assert translation_error(solution.T_map_camera, POSE) < 0.03
    assert (solution.inliers[~wrong]).mean() > 0.95
    assert 0.3 < solution.reprojection_error < 1.2


def test_the_same_seed_gives_the_same_answer() -> None:
    found, _ = scene(4, outliers=0.5)
    a, b = (solve_pose(CAMERA, found, PoseOptions(), seed=7) for _ in range(2))
    np.testing.assert_array_equal(a.T_map_camera, b.T_map_camera)
    np.testing.assert_array_equal(a.covariance, b.covariance)


@pytest.mark.parametrize("count", range(MIN_POINTS))
def test_too_few_points_are_no_answer(count: int) -> None:
    found, _ = scene(0, count=count)
    assert solve_pose(CAMERA, found, PoseOptions(), seed=0) is None


def test_points_that_determine_no_pose_are_no_answer() -> None:
    """All matches at one point: any rotation about the ray will do."""
    found = exact(np.full((50, 2), 100.0), np.full((50, 3), 2.0))
    assert solve_pose(CAMERA, found, PoseOptions(), seed=0) is None


def test_noise_alone_finds_few_inliers() -> None:
    rng = np.random.default_rng(0)
    found = exact(rng.uniform([0, 0], [639, 479], (100, 2)), rng.uniform(-3, 3, (100, 3)))
    solution = solve_pose(CAMERA, found, PoseOptions(), seed=0)
    assert solution is None or solution.inliers.sum() < 10


def test_a_pose_that_is_not_plausible_gives_way_to_one_that_is() -> None:
    """As when most of the photo shows something that is seen elsewhere in the map."""
    most, _ = scene(0, count=200)
    elsewhere = make_pose(so3_exp(np.array([0.0, 0.0, 2.0])), np.array([5.0, 0.0, 0.0]))
    fewer, _ = scene(1, count=100)
    found = Correspondences(
        np.concatenate([most.pixels, fewer.pixels]),
        np.concatenate([transform(elsewhere, most.points), fewer.points]),
        np.zeros((300, 3)),
    )
    assert translation_error(solve_pose(CAMERA, found, PoseOptions(), 0).T_map_camera, elsewhere @ POSE) < 0.05
    near = solve_pose(CAMERA, found, PoseOptions(), 0, lambda pose: translation_error(pose, POSE) < 1)
    assert translation_error(near.T_map_camera, POSE) < 0.05
    assert near.inliers.shape == (300,)
    assert near.inliers[200:].mean() > 0.95 > 0.1 > near.inliers[:200].mean()
    # Where no pose is plausible, the first is told: the verdict says what is wrong with it.
    far = solve_pose(CAMERA, found, PoseOptions(), 0, lambda pose: False)
    assert translation_error(far.T_map_camera, elsewhere @ POSE) < 0.05


def test_neighbours_that_are_off_alike_widen_the_covariance() -> None:
    found, _ = scene(0, count=600, noise=0.3)
    usual = refine_pose(CAMERA, POSE, found, PoseOptions())[1]
    bent = replace(found, pixels=found.pixels + 1.5 * np.sin(found.pixels[:, ::-1] / 40.0))
    assert np.trace(refine_pose(CAMERA, POSE, bent, PoseOptions())[1]) > 4 * np.trace(usual)


def test_jacobians_equal_finite_differences() -> None:
    found, _ = scene(1, count=20)
    camera = Camera(640, 480, np.array([[600.0, 3.0, 315], [0, 610.0, 245], [0, 0, 1]]))

    def residuals(by_pose: np.ndarray, by_point: np.ndarray) -> np.ndarray:
        pose = make_pose(so3_exp(by_pose[3:]) @ POSE[:3, :3], POSE[:3, 3] + by_pose[:3])
        return linearize(camera, pose, found.points + by_point).projected

    linear = linearize(camera, POSE, found.points)
    step = 1e-6
    for k, delta in enumerate(step * np.eye(6)):
        slope = (residuals(delta, np.zeros(3)) - residuals(-delta, np.zeros(3))) / (2 * step)
        np.testing.assert_allclose(linear.by_state[:, :, k], slope, rtol=1e-5, atol=1e-4)
    for k, delta in enumerate(step * np.eye(3)):
        slope = (residuals(np.zeros(6), delta) - residuals(np.zeros(6), -delta)) / (2 * step)
        np.testing.assert_allclose(linear.by_point[:, :, k], slope, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("depth_noise", [0.0, 0.2], ids=["keypoint noise", "keypoint and depth noise"])
def test_covariance_of_independent_errors_is_that_of_many_trials(depth_noise: float) -> None:
    """Normalised estimation error squared per degree of freedom is 1 when the covariance is true.

    For Gaussian noise, the narrow loss that real residuals call for errs to safety, and so does what neighbours have in
    common by chance.
    """
    nees = []
    for seed in range(150):
        found, _ = scene(seed, noise=0.7)
        points = found.points
        rng = np.random.default_rng(seed)
        # Each point was lifted on a ray of another camera, one unit to the side.
        rays = points - (POSE[:3, 3] + [1.0, 0.5, 0])
        sigmas = depth_noise * rays / np.linalg.norm(rays, axis=1, keepdims=True)
        moved = points + sigmas * rng.normal(size=(len(points), 1))
        lifted = Correspondences(found.pixels, moved, sigmas)
        pose, covariance = refine_pose(CAMERA, POSE, lifted, PoseOptions(shared_share=0.0))
        error = np.concatenate([pose[:3, 3] - POSE[:3, 3], so3_log(pose[:3, :3] @ POSE[:3, :3].T)])
        nees.append(error @ np.linalg.solve(covariance, error) / 6)
    assert 0.4 < np.mean(nees) < 1.2


def test_errors_that_matches_share_do_not_average_out() -> None:
    """A hundred times the matches leave the covariance nearly as large."""
    few, many = (
        refine_pose(CAMERA, POSE, found, PoseOptions())[1]
        for found, _ in (scene(0, count=1000, noise=0.3), scene(0, count=100_000, noise=0.3))
    )
    assert np.trace(many[:3, :3]) > 0.5 * np.trace(few[:3, :3])


def test_in_a_bent_map_the_covariance_grows() -> None:
    found, _ = scene(0, noise=0.3)
    bent = replace(found, pixels=found.pixels + 0.6 * np.sin(found.pixels[:, ::-1] / 60))
    plain, wide = (refine_pose(CAMERA, POSE, each, PoseOptions())[1] for each in (found, bent))
    assert np.trace(wide[3:, 3:]) > 100 * np.trace(plain[3:, 3:])


def test_reprojection_error_behind_the_camera_is_infinite() -> None:
    behind = transform(POSE, np.array([[0.1, 0.2, -3.0]]))
    assert np.isinf(reprojection_errors(CAMERA, POSE, exact(np.zeros((1, 2)), behind))).all()


def test_refinement_refuses_points_behind_the_camera() -> None:
    found, _ = scene(0)
    found.points[0] = transform(POSE, np.array([[0, 0, -1.0]]))[0]
    assert refine_pose(CAMERA, POSE, found, PoseOptions()) is None


def loss_at(pose: np.ndarray, found: Correspondences) -> tuple[float, np.ndarray]:
    """Cauchy's loss of residuals, not whitened, and how far (6,) it is from the least, in standard deviations."""
    linear = linearize(CAMERA, pose, found.points)
    whitening = np.tile(np.eye(2), (len(found.pixels), 1, 1))
    equations = normal_equations(whitening, linear.projected - found.pixels, linear.by_state, 6, 1.0)
    covariance = np.linalg.inv(equations.hessian)
    return np.log1p(equations.squared).sum(), covariance @ equations.gradient / np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("off", [1e-9, 0.01, 0.2])
def test_descends_to_where_the_loss_is_least(seed: int, off: float) -> None:
    found, _ = scene(seed, noise=0.7)
    start = moved(POSE, off * np.random.default_rng(seed).normal(size=6))
    pose, whitening = start.copy(), np.tile(np.eye(2), (len(found.pixels), 1, 1))
    assert descend(CAMERA.K, pose, found.points, found.pixels, whitening, 1.0, 100, 1e-9)
    loss, step = loss_at(pose, found)
    assert loss <= loss_at(start, found)[0]
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.abs(step).max() < 1e-2
    # A few steps go there by and by; none leads up.
    losses, pose = [], start.copy()
    for _ in range(3):
        descend(CAMERA.K, pose, found.points, found.pixels, whitening, 1.0, 1, 0.0)
        losses.append(loss_at(pose, found)[0])
    assert losses == sorted(losses, reverse=True)


def test_where_any_pose_will_do_there_is_no_descent() -> None:
    found, _ = scene(0)
    nothing_known = np.zeros((len(found.pixels), 2, 2))
    assert not descend(CAMERA.K, POSE.copy(), found.points, found.pixels, nothing_known, 1.0, 20, 1e-7)


def test_near_the_pose_it_is_solved_for_without_sampling() -> None:
    found, _ = scene(0, noise=0.3, outliers=0.2)
    sampled = solve_pose(CAMERA, found, PoseOptions(), seed=0)
    near = solve_near(CAMERA, moved(POSE, np.full(6, 2e-4)), found, PoseOptions())
    np.testing.assert_allclose(near.T_map_camera, sampled.T_map_camera, atol=1e-4)
    np.testing.assert_allclose(np.diag(near.covariance), np.diag(sampled.covariance), rtol=0.1)
    assert solve_near(CAMERA, moved(POSE, np.full(6, 0.05)), found, PoseOptions()) is None
    assert solve_near(CAMERA, POSE, found.select(np.zeros(0, int)), PoseOptions()) is None
