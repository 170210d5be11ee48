"""Answers against odometry: what is wrong is named, with its value, and nothing is where all is right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checked_drives import Wrong, flying, keyframes, planar, straight

from gsfeatloc_ros.crosscheck.drive import CORRECTIONS, Drive
from gsfeatloc_ros.crosscheck.fit import Cause, Fit, explain

RIGHT = Wrong()


def explained(path, wrong: Wrong = RIGHT, noise: float = 0.005, seed: int = 0, count: int = 25) -> Fit:
    return explain(Drive(keyframes(path, count, wrong, noise, seed)))


def test_without_errors_nothing_is_off():
    made = keyframes(flying, 5, noise=0.0, answer=(1e-9, 1e-9))
    np.testing.assert_allclose(Drive(made).residuals(np.zeros(CORRECTIONS)), 0.0, atol=1e-7)
    assert explain(Drive(made)).cause is None


def test_two_answers_tell_nothing():
    assert explained(planar, Wrong(scale=1.3), count=2).cause is None


@pytest.mark.parametrize("path", [planar, flying, straight])
@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(3, 34), marks=pytest.mark.nightly)], ids=str)
def test_nothing_is_named_when_all_is_right(path, seeds):
    """Of each kind of drive one by each noise; of a hundred in the night."""
    noises = [0.0, 0.01, 0.05]
    causes = {explained(path, noise=noises[seed % 3], seed=seed, count=20).cause for seed in seeds}
    assert causes == {None}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))])
@pytest.mark.parametrize(
    ("path", "wrong", "cause", "value"),
    [
        (planar, Wrong(scale=1.3), Cause.SCALE, [1 / 1.3 - 1]),
        (straight, Wrong(scale=0.7), Cause.SCALE, [1 / 0.7 - 1]),
        (planar, Wrong(delay=0.08), Cause.DELAY, [0.08]),
        (flying, Wrong(delay=-0.05), Cause.DELAY, [-0.05]),
        (planar, Wrong(lever=(0.05, 0.0, 0.0)), Cause.LEVER, [0.05, 0.0, 0.0]),
        (flying, Wrong(lever=(0.0, 0.03, -0.05)), Cause.LEVER, [0.0, 0.03, -0.05]),
        (planar, Wrong(rotation=(0.0, 0.0, 0.05)), Cause.ROTATION, [0.0, 0.0, 0.05]),
        (flying, Wrong(rotation=(0.03, -0.04, 0.0)), Cause.ROTATION, [0.03, -0.04, 0.0]),
    ],
)
def test_what_is_wrong_is_named_with_its_value(path, wrong, cause, value, seed):
    fit = explained(path, wrong, seed=seed)
    assert fit.cause is cause
    size = np.linalg.norm(value)
    assert np.linalg.norm((fit.value - value)[fit.told]) < max(0.1 * size, 4.0 * np.linalg.norm(fit.sigmas[fit.told]))
    assert fit.size == pytest.approx(size, rel=0.1)


@pytest.mark.parametrize(
    "wrong", [Wrong(delay=0.08), Wrong(lever=(0.05, 0.0, 0.0)), Wrong(lever=(0.0, 0.0, 0.3))], ids=str
)
def test_what_a_straight_even_drive_does_not_tell_is_not_named(wrong):
    assert explained(straight, wrong).cause is None


def test_on_the_floor_the_height_of_the_camera_is_not_told():
    fit = explained(planar, Wrong(lever=(0.05, 0.0, 0.3)))
    assert fit.told.tolist() == [True, True, False]
    np.testing.assert_allclose(fit.value[:2], [0.05, 0.0], atol=0.005)


def test_the_deviation_is_that_of_the_values():
    """Of scales by many drives."""
    fits = [explained(planar, Wrong(scale=1.3), 0.02, seed) for seed in range(12)]
    values, sigmas = np.array([(fit.value[0], fit.sigma) for fit in fits]).T
    assert abs(values.mean() - (1 / 1.3 - 1)) < 4.0 * values.std() / np.sqrt(12)
    assert sigmas.mean() == pytest.approx(values.std(), rel=0.5)


def test_an_odometry_that_is_bad_explains_itself():
    """Ten times as bad as the error of the scale is large."""
    fit = explained(planar, Wrong(scale=1.03), noise=0.3)
    assert fit.cause is None
    assert fit.noise == pytest.approx(0.3, rel=0.5)


def test_answers_that_claim_less_are_believed_less():
    made = keyframes(planar, 25, Wrong(delay=0.03))
    assert explain(Drive(made)).cause is Cause.DELAY
    made = [replace(keyframe, covariance=1e3 * keyframe.covariance) for keyframe in made]
    assert explain(Drive(made)).cause is None
