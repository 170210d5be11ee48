"""Which images are due: by the mode, and by the largest rate."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.ros_io.schedule import Schedule
from gsfeatloc_ros.ros_io.settings import CONTINUOUS, ON_PRIOR, ON_REQUEST, NodeSettings

SECOND = 10**9


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


@given(st.lists(st.integers(0, SECOND), max_size=50), st.floats(0.5, 20))
def test_no_two_are_due_closer_than_the_rate_allows(steps, rate):
    schedule, stamp, due = Schedule(NodeSettings(mode=CONTINUOUS, max_rate=rate)), 10 * SECOND, []
    for step in steps:
        stamp += step
        if schedule.is_due(stamp):
            due.append(stamp)
        else:
            assert stamp - due[-1] < SECOND / rate
    assert all(after - before >= SECOND / rate for before, after in itertools.pairwise(due))


def test_a_bag_that_starts_anew_is_due_at_once():
    schedule = Schedule(NodeSettings(max_rate=1.0))
    assert [schedule.is_due(stamp * SECOND) for stamp in (100, 5, 6)] == [True, True, True]
