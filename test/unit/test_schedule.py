"""Which images are due: by the mode, and by the largest rate."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.ros_io.schedule import Schedule
from gsfeatloc_ros.ros_io.settings import CONTINUOUS, ON_PRIOR, ON_REQUEST, NodeSettings

SECOND = 10**9
# Images in which the turns settle.
SETTLING = 60


def test_each_prior_makes_one_image_due():
    schedule = Schedule(NodeSettings(mode=ON_PRIOR))
    assert not schedule.is_due(1)
    schedule.take_prior(True)
    assert schedule.is_due(2)
    assert not schedule.is_due(3)
    schedule.take_prior(True)
    schedule.take_prior(False)  # it took the place of the good one
    assert not schedule.is_due(4)


def test_on_request_none_is_due():
    schedule = Schedule(NodeSettings(mode=ON_REQUEST))
    schedule.take_prior(True)
    assert not schedule.is_due(1)


def due_images(camera_rate, max_rate, count, jitter, seed=0):
    """Numbers of the images that are due, of a camera whose stamps are off by up to `jitter` of its period."""
    off = np.random.default_rng(seed).uniform(-jitter, jitter, count)
    stamps = np.round(SECOND * (1000 + (np.arange(count) + off) / camera_rate)).astype(int)
    schedule = Schedule(NodeSettings(mode=CONTINUOUS, max_rate=max_rate))
    return [number for number, stamp in enumerate(stamps.tolist()) if schedule.is_due(stamp)]


@given(st.floats(29.9, 30.1), st.floats(0.0, 0.15), st.integers(0, 1000))
def test_of_a_camera_at_30_hz_and_10_at_most_every_third_image_is_due(camera_rate, jitter, seed):
    """Turns settle up to a quarter of a step beside the images: with more jitter another may be within half a step."""
    due = due_images(camera_rate, 10.0, 400, jitter, seed)
    assert due == list(range(0, 400, 3))


@given(st.floats(1.0, 120.0), st.floats(0.5, 100.0))
def test_images_are_due_evenly_whatever_the_rates(camera_rate, max_rate):
    every = max(camera_rate / max_rate, 1.0)
    due = due_images(camera_rate, max_rate, SETTLING + math.ceil(50 * every), jitter=0.0)
    gaps = np.diff([number for number in due if number >= SETTLING])
    assert len(gaps) == 0 or set(gaps.tolist()) <= {math.floor(every), math.ceil(every)}
    # No long runs of the one or of the other either: after any of them the turns are made up for.
    assert np.abs(np.cumsum(gaps - every)).max(initial=0.0) <= 1.0 + 0.02 * every * len(gaps)


@pytest.mark.parametrize(("camera_rate", "max_rate"), [(30, 12), (25, 10), (30, 7), (15, 10), (10.4, 10), (60, 1)])
def test_where_rates_do_not_divide_as_many_are_due_as_may_be(camera_rate, max_rate):
    due = due_images(camera_rate, max_rate, 3000, jitter=0.15)
    assert len(due) / 3000 * camera_rate == pytest.approx(max_rate, rel=0.025)


@given(st.lists(st.integers(0, SECOND), max_size=100), st.floats(0.5, 20))
def test_the_rate_is_not_exceeded_whatever_comes(steps, rate):
    schedule, due = Schedule(NodeSettings(mode=CONTINUOUS, max_rate=rate)), []
    for stamp in itertools.accumulate(steps, initial=10 * SECOND):
        if schedule.is_due(stamp):
            due.append(stamp / SECOND)
    for first, last in itertools.combinations(range(len(due)), 2):
        assert last - first <= 1.02 * rate * (due[last] - due[first]) + 1.0


def test_what_did_not_come_in_time_is_not_made_up_for():
    schedule = Schedule(NodeSettings(max_rate=10.0))
    stamps = [*range(0, SECOND, SECOND // 30), *range(5 * SECOND, 6 * SECOND, SECOND // 30)]
    due = [stamp for stamp in stamps if schedule.is_due(stamp)]
    assert len(due) == 2 * 11
    assert min(np.diff(due)) > 0.09 * SECOND


def test_a_bag_that_starts_anew_is_due_at_once():
    schedule = Schedule(NodeSettings(max_rate=1.0))
    assert [schedule.is_due(stamp * SECOND) for stamp in (100, 5, 6)] == [True, True, True]
