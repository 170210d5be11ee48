"""A camera that is not as it was calibrated, told from exact matches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp, so3_log, transform
from gsfeatloc_ros.pose.camera_fit import CameraFit, fit_camera
from gsfeatloc_ros.pose.linear import linearize
from gsfeatloc_ros.pose.solve import Correspondences, PoseOptions, PoseSolution, solve_pose

CAMERA = Camera(640, 480, np.array([[600.0, 0, 315], [0, 610.0, 245], [0, 0, 1]]))
POSE = make_pose(so3_exp(np.array([0.4, -1.1, 0.3])), np.array([2.0, -1.0, 0.5]))
ROLLING = np.array([0.004, -0.012, 0.006])


def seen(
    camera: Camera,
    k1: float = 0.0,
    rolling: np.ndarray | None = None,
    depths: tuple[float, float] = (2, 8),
    seed: int = 0,
) -> Correspondences:
    """What a camera at POSE sees of random points, rows one after another where it is turned by `rolling` meanwhile."""
    rng = np.random.default_rng(seed)
    points = transform(POSE, CAMERA.rays(rng.uniform([0, 0], [639, 479], (600, 2))) * rng.uniform(*depths, (600, 1)))
    pixels = np.full((600, 2), 240.0)
    for _ in range(1 if rolling is None else 5):  # the row at which a point is read depends on where it is seen
        when = (pixels[:, 1:] + 0.5) / camera.height - 0.5
        turned = Rotation.from_rotvec(when * (np.zeros(3) if rolling is None else rolling))
        in_camera = turned.inv().apply(transform(invert(POSE), points))
        slopes = in_camera[:, :2] / in_camera[:, 2:]
        slopes = slopes * (1 + k1 * (slopes**2).sum(axis=1, keepdims=True))
        pixels = slopes * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    return Correspondences(pixels + 0.3 * rng.normal(size=pixels.shape), points, np.zeros_like(points))


def fitted(found: Correspondences):
    """The fit from the pose that the calibration gives."""
    solution = solve_pose(CAMERA, found, PoseOptions(max_reprojection_error=20.0), seed=0)
    return fit_camera(CAMERA, solution.T_map_camera, found, PoseOptions()), solution


def longer(error: float) -> Camera:
    return replace(CAMERA, K=CAMERA.K @ np.diag([1 + error, 1 + error, 1]))


def test_a_right_calibration_reads_as_right() -> None:
    fit, _ = fitted(seen(CAMERA))
    assert abs(fit.focal) < 3 * fit.focal_sigma < 0.01
    assert abs(fit.k1) < 3 * fit.k1_sigma
    assert (np.abs(fit.rolling) < 3 * fit.rolling_sigma).all()


@pytest.mark.parametrize("error", [-0.1, -0.02, 0.01, 0.05])
def test_the_focal_length_is_told(error: float) -> None:
    fit, _ = fitted(seen(longer(error)))
    assert fit.focal == pytest.approx(error, abs=0.003)
    assert 0 < fit.focal_sigma < 0.01
    # The pose keeps to the calibration.
    assert abs(fit.followed[0]) < 1e-4


def test_radial_distortion_is_told_and_followed() -> None:
    fit, solution = fitted(seen(CAMERA, k1=-0.05))
    assert fit.k1 == pytest.approx(-0.05, abs=0.01)
    assert off(fit) < 0.3 * off(solution)


def test_a_rolling_shutter_is_told_and_followed() -> None:
    found = seen(CAMERA, rolling=ROLLING)
    fit, solution = fitted(found)
    np.testing.assert_allclose(fit.rolling, ROLLING, atol=1.5e-3)
    assert off(fit) < 0.3 * off(solution)
    assert np.median(fit.reprojection_errors(CAMERA, found)) < 0.5 < np.median(solution.errors)


def off(answer: CameraFit | PoseSolution) -> float:
    """How far an answer is from POSE, with a radian for a unit."""
    turn = so3_log(POSE[:3, :3] @ answer.T_map_camera[:3, :3].T)
    return float(np.linalg.norm(np.concatenate([answer.T_map_camera[:3, 3] - POSE[:3, 3], turn])))


@pytest.mark.parametrize(
    ("error", "k1", "turn"), [(0.0, 0.0, 0.0), (0.002, 0.0, 0.0), (0.0, -0.01, 0.0), (0.0, 0.0, 1)]
)
def test_the_covariance_allows_for_what_a_calibration_in_use_is_off_by(error: float, k1: float, turn: float) -> None:
    squares = [nees(seen(longer(error), k1=k1, rolling=0.2 * turn * ROLLING, seed=seed)) for seed in range(20)]
    assert np.mean(squares) < 1.2


@pytest.mark.parametrize("error", [-0.03, 0.0, 0.02])
def test_the_covariance_allows_for_a_focal_length_that_reads_as_off(error: float) -> None:
    """A shallow scene hardly shows it, and it moves the pose."""
    squares = [nees(seen(longer(error), depths=(4, 4.5), seed=seed)) for seed in range(20)]
    assert np.mean(squares) < 1.2


@pytest.mark.parametrize(
    ("error", "k1", "turn"), [(0.0, 0.0, 0.0), (-0.05, 0.0, 0.0), (0.02, -0.1, 0.0), (0.02, 0.0, 3)]
)
def test_the_focal_length_is_told_as_surely_as_it_reads(error: float, k1: float, turn: float) -> None:
    """What the lens and the shutter are taken to be must not pass for another focal length."""
    squares = []
    for seed in range(20):
        found = seen(longer(error), k1, turn * ROLLING, depths=(4, 5), seed=seed)
        in_a_quarter = np.flatnonzero((found.pixels < [320, 240]).all(axis=1))[:60]
        fit, _ = fitted(found.select(in_a_quarter))
        squares.append(((fit.focal - error) / fit.focal_sigma) ** 2)
    assert np.mean(squares) < 1.2


@pytest.mark.parametrize("error", [-0.1, 0.1])
@pytest.mark.parametrize("seed", range(5))
def test_a_few_wrong_depths_do_not_hold_a_wrong_focal_length(error: float, seed: int) -> None:
    """Corners of a wall beside what is near, which were lifted onto that, agree with the pose of the calibration."""
    found = seen(longer(error), depths=(4, 4.3), seed=seed).select(np.arange(180))
    T = fitted(found)[1].T_map_camera
    found.points[:4] = transform(T, CAMERA.rays(found.pixels[:4]) * 1.8)
    fit = fit_camera(CAMERA, T, found, PoseOptions())
    assert abs(fit.focal - error) < 3 * fit.focal_sigma < 0.1
    assert abs(fit.focal) > 0.5 * abs(error)


@pytest.mark.parametrize("seed", range(5))
def test_no_match_tells_the_focal_length_alone(seed: int) -> None:
    """Of a wall from the front, one corner that was lifted onto something near would say that all is well."""
    found = seen(longer(0.08), depths=(4, 4.1), seed=seed).select(np.arange(100))
    T = fitted(found)[1].T_map_camera
    found.points[0] = transform(T, CAMERA.rays(found.pixels[:1]) * 2.5)
    fit, without = (fit_camera(CAMERA, T, each, PoseOptions()) for each in (found, found.select(np.arange(1, 100))))
    assert fit.focal_sigma > 0.8 * without.focal_sigma
    assert abs(fit.focal - 0.08) < 3 * fit.focal_sigma


def nees(found: Correspondences) -> float:
    """The normalised squared error of the fit, per degree of freedom."""
    fit, _ = fitted(found)
    rotation = so3_log(POSE[:3, :3] @ fit.T_map_camera[:3, :3].T)
    deviation = np.concatenate([POSE[:3, 3] - fit.T_map_camera[:3, 3], rotation])
    return float(deviation @ np.linalg.solve(fit.covariance, deviation) / 6)


def test_what_is_behind_the_camera_is_infinitely_far_off() -> None:
    found = seen(CAMERA)
    fit, _ = fitted(found)
    found.points[0] = transform(POSE, np.array([[0, 0, -1.0]]))[0]
    errors = fit.reprojection_errors(CAMERA, found)
    assert np.isinf(errors[0])
    assert np.isfinite(errors[1:]).all()


def test_jacobians_equal_finite_differences() -> None:
    found = seen(CAMERA).select(np.arange(30))
    extra = np.array([0.02, 0.0, 0.0, 0.0, 0.0])  # how the others change the slope is left out: they are small

    def residuals(step: np.ndarray) -> np.ndarray:
        pose = make_pose(so3_exp(step[3:6]) @ POSE[:3, :3], POSE[:3, 3] + step[:3])
        return linearize(CAMERA, pose, found.points, extra + step[6:], found.pixels[:, 1]).projected

    jacobian = linearize(CAMERA, POSE, found.points, extra, found.pixels[:, 1]).by_state
    size = 1e-6
    for column, step in enumerate(size * np.eye(11)):
        slope = (residuals(step) - residuals(-step)) / (2 * size)
        np.testing.assert_allclose(jacobian[:, :, column], slope, rtol=1e-4, atol=1e-3)


def test_points_behind_the_camera_are_no_fit() -> None:
    found = seen(CAMERA)
    found.points[0] = transform(POSE, np.array([[0, 0, -1.0]]))[0]
    assert fit_camera(CAMERA, POSE, found, PoseOptions()) is None


def test_matches_that_determine_no_pose_are_no_fit() -> None:
    found = Correspondences(np.full((30, 2), 100.0), np.full((30, 3), 5.0), np.zeros((30, 3)))
    fit = fit_camera(CAMERA, make_pose(np.eye(3), np.zeros(3)), found, PoseOptions())
    assert fit is None or np.isfinite(fit.covariance).all()
