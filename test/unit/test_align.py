"""The similarity from a map's frame to the robot's, of simulated drives whose similarity is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drives import Errors, as_pairs, curve, error_of, line, random_similarity
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gsfeatloc_ros.align.consensus import MIN_PAIRS, agreeing
from gsfeatloc_ros.align.determination import Precision, check, report
from gsfeatloc_ros.align.fit import UndeterminedError, fit_drive
from gsfeatloc_ros.align.pairs import Answer, Pairs, match
from gsfeatloc_ros.align.umeyama import umeyama
from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.replay.truth import Trajectory

few = settings(deadline=None, max_examples=10)
NOISE = Errors(position=0.01, rotation=0.5)


def drive(seed: int, true: np.ndarray, errors: Errors = NOISE):
    """Return pairs and their true similarity."""
    rng = np.random.default_rng(seed)
    S_robot_map = random_similarity(rng)
    return as_pairs(true, S_robot_map, errors, rng), S_robot_map


def test_nothing_determines_nothing():
    none = Pairs(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), np.zeros((0, 2)))
    with pytest.raises(UndeterminedError, match=f"0 photos .* at least {MIN_PAIRS}"):
        fit_drive(none)
    assert len(match([], Trajectory([]), oriented=True)) == 0


@few
@given(st.integers(0, 10**6), st.booleans())
def test_a_similarity_is_recovered_exactly_without_noise(seed, oriented):
    pairs, truth = drive(seed, curve(8), Errors())
    fit = fit_drive(replace(pairs, oriented=oriented))
    assert np.abs(error_of(fit, truth)).max() < 1e-9
    np.testing.assert_allclose(fit.S_robot_map.translation, truth.translation, atol=1e-8)


@few
@given(st.integers(0, 10**6))
def test_umeyama_agrees_with_other_solvers(seed):
    pairs, _ = drive(seed, curve(8), Errors(position=0.3))
    found = umeyama(replace(pairs, oriented=False))
    p, q = pairs.answers[:, :3, 3], pairs.references[:, :3, 3]
    rotation, _ = Rotation.align_vectors(q - q.mean(axis=0), p - p.mean(axis=0))
    np.testing.assert_allclose(found.rotation, rotation.as_matrix(), atol=1e-6)

    def off(x):
        return (q - np.exp(x[0]) * Rotation.from_rotvec(x[1:4]).apply(p) - x[4:]).ravel()

    start = np.concatenate([[0.0], rotation.as_rotvec(), q.mean(axis=0)])
    best = least_squares(off, start, xtol=1e-14, ftol=1e-14).x
    assert found.scale == pytest.approx(np.exp(best[0]), rel=1e-5)
    np.testing.assert_allclose(found.translation, best[4:], atol=1e-4)


def test_wrong_answers_and_jumps_do_not_matter():
    pairs, truth = drive(3, curve())
    rng = np.random.default_rng(0)
    pairs.answers[::3, :3, 3] += rng.normal(0, 3, (7, 3))
    assert not agreeing(pairs, seed=0)[::3].any()
    fit = fit_drive(pairs)
    assert len(fit.pairs) >= 12
    assert fit.given == 20
    assert np.abs(error_of(fit, truth))[0] < 0.005


@pytest.mark.parametrize("errors", [NOISE, Errors(0.01, 0.5, step=0.01)])
def test_deviations_are_those_of_the_errors(errors):
    trials = [(fit_drive(pairs), truth) for pairs, truth in (drive(seed, curve(), errors) for seed in range(6))]
    off = [error_of(fit, truth) for fit, truth in trials]
    nees = [e @ np.linalg.solve(fit.covariance, e) / 7 for e, (fit, _) in zip(off, trials, strict=True)]
    assert 0.3 < np.mean(nees) < 2.0
    assert max(abs(e[0]) for e in off) < 0.01


def test_a_line_leaves_the_turn_about_itself_to_the_orientations():
    pairs, truth = drive(5, line())
    fit = fit_drive(pairs)
    check(fit, Precision())
    assert np.degrees(np.abs(error_of(fit, truth)[1:4])).max() < 0.6
    assert any(text.startswith("the turn about (1.00") and "orientations" in text for text in report(fit))
    blind = fit_drive(replace(pairs, oriented=False))
    with pytest.raises(UndeterminedError, match=r"turn about \(-?1.00 .*: drive a curve, or give orientations"):
        check(blind, Precision())


def test_a_drive_on_the_spot_leaves_the_scale_open():
    pairs, _ = drive(5, make_still(curve()))
    with pytest.raises(UndeterminedError, match=r"the scale .*: drive farther"):
        check(fit_drive(pairs), Precision())


def make_still(poses: np.ndarray) -> np.ndarray:
    """Return the same turns, all in one place."""
    return np.array([make_pose(pose[:3, :3], [1.0, 1.0, 0.5]) for pose in poses])


def test_the_poses_of_another_body_are_told():
    pairs, _ = drive(7, curve())
    mounted = make_pose(so3_exp(np.radians([0, 12, 0])), [0.05, 0.0, 0.1])
    with pytest.raises(UndeterminedError, match=r"orientations are turned by 1[0-3]"):
        check(fit_drive(replace(pairs, references=pairs.references @ mounted)), Precision())


def test_answers_are_matched_with_the_trajectory_at_their_time():
    poses = curve(3)
    trajectory = Trajectory([(0, poses[0]), (10**8, poses[1]), (10**9, poses[2])])
    answers = [Answer(stamp, poses[0], np.zeros(2)) for stamp in (2 * 10**9, 5 * 10**7, 5 * 10**8, 0)]
    pairs = match(answers, trajectory, oriented=True)
    assert len(pairs) == 2
    np.testing.assert_allclose(pairs.references[1, :3, 3], (poses[0, :3, 3] + poses[1, :3, 3]) / 2)


def test_orientations_that_never_turn_are_not_believed():
    stamps = range(5)
    poses = curve(5)
    still = [(stamp, make_pose(np.eye(3), pose[:3, 3])) for stamp, pose in zip(stamps, poses, strict=True)]
    answers = [Answer(stamp, pose, np.zeros(2)) for stamp, pose in zip(stamps, poses, strict=True)]
    assert not match(answers, Trajectory(still), oriented=True).oriented
    assert match(answers, Trajectory(zip(stamps, poses, strict=True)), oriented=True).oriented
