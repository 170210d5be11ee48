"""Where the robot stands, and which answers it may go on from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.ros_io.growth import Growth, GrowthOptions, Travelled, position_sigma, rotation_sigma
from gsfeatloc_ros.ros_io.prior import PriorPolicy, PriorSource
from gsfeatloc_ros.ros_io.state import Attempt, Decision, Judgement, LocalizationState, State, StateOptions

SECOND = 10**9
HERE = np.eye(4)
NEAR = make_pose(so3_exp(np.array([0.0, 0.1, 0.0])), [0.2, 0.0, 0.0])
FAR = make_pose(so3_exp(np.array([0.0, 1.5, 0.0])), [3.0, 0.0, 0.0])
COVARIANCE = PriorPolicy().default_covariance()
OWN = (PriorSource.LAST_ANSWER, PriorSource.UNCONFIRMED)


class Robot:
    """A state, and the time that it reads."""

    def __init__(self, **options: float) -> None:
        self.time = 1000 * SECOND
        self.state = LocalizationState(StateOptions(**options), lambda: self.time)

    def wait(self, seconds: float) -> None:
        self.time += round(seconds * SECOND)

    def answer(self, source: PriorSource | None, pose: np.ndarray = HERE, confirmable: bool = True) -> Judgement:
        """What is to be done with the answer `pose` to an image that was thought to be taken HERE."""
        prior, covariance = (None, None) if source is None else (HERE, COVARIANCE)
        return self.state.take(Attempt(source, prior, covariance, pose, confirmable))

    def fail(self, source: PriorSource | None = None) -> Judgement:
        return self.state.take(Attempt(source, confirmable=True))

    @property
    def now(self) -> State:
        return self.state.standing().state


def test_at_first_it_is_lost():
    standing = Robot().state.standing()
    assert (standing.state, standing.reason, standing.seconds) == (State.LOST, "nothing was localized yet", 0.0)


@pytest.mark.parametrize("source", [PriorSource.PRIOR, PriorSource.INITIAL_POSE, PriorSource.LAST_ANSWER])
def test_an_answer_from_a_prior_is_published_at_once(source):
    robot = Robot()
    robot.wait(3.0)
    judgement = robot.answer(source, NEAR)
    assert judgement == Judgement(Decision.PUBLISH, "found again after 3.0 s")
    assert robot.now is State.LOCALIZED
    assert robot.answer(source, NEAR) == Judgement(Decision.PUBLISH)


@pytest.mark.parametrize("source", [None, PriorSource.SAVED, PriorSource.PLANE])
def test_an_answer_without_a_prior_waits_for_another_that_agrees(source):
    robot = Robot()
    first = robot.answer(source, FAR)
    assert first == Judgement(Decision.AWAIT, "found without a prior: the next image has to agree")
    assert robot.now is State.LOST
    assert robot.answer(PriorSource.UNCONFIRMED, NEAR).decision is Decision.PUBLISH
    assert robot.now is State.LOCALIZED


def test_an_answer_that_does_not_agree_takes_the_place_of_the_first():
    robot = Robot()
    robot.answer(None)
    assert robot.answer(PriorSource.UNCONFIRMED, FAR).decision is Decision.AWAIT
    assert robot.now is State.LOST
    assert robot.answer(PriorSource.UNCONFIRMED, NEAR).decision is Decision.PUBLISH


def test_an_image_without_an_answer_does_not_confirm():
    robot = Robot()
    robot.answer(None)
    assert robot.fail(PriorSource.UNCONFIRMED) == Judgement(Decision.FORGET, "the answer before was not confirmed")
    assert robot.answer(None).decision is Decision.AWAIT


def test_without_odometry_nothing_can_be_confirmed():
    robot = Robot()
    assert robot.answer(None, confirmable=False).decision is Decision.PUBLISH
    assert robot.now is State.LOCALIZED


@given(confirm=st.integers(0, 5))
def test_so_many_images_confirm(confirm):
    robot = Robot(confirm=confirm)
    decisions = [robot.answer(PriorSource.UNCONFIRMED if i else None).decision for i in range(confirm + 1)]
    assert decisions == [Decision.AWAIT] * confirm + [Decision.PUBLISH]


def test_a_jump_is_confirmed_and_announced():
    robot = Robot()
    robot.answer(PriorSource.PRIOR)
    jump = robot.answer(PriorSource.LAST_ANSWER, FAR)
    assert jump.decision is Decision.AWAIT
    assert jump.note == "the pose jumps by 3.00 and 86 degrees: the next image has to agree"
    assert robot.now is State.LOCALIZED
    assert robot.answer(PriorSource.UNCONFIRMED).decision is Decision.PUBLISH


def test_a_jump_without_odometry_is_announced():
    robot = Robot()
    robot.answer(PriorSource.PRIOR)
    judgement = robot.answer(PriorSource.LAST_ANSWER, FAR, confirmable=False)
    assert judgement == Judgement(Decision.PUBLISH, "the pose jumps by 3.00 and 86 degrees")


def test_what_came_from_outside_may_be_anywhere():
    robot = Robot()
    robot.answer(PriorSource.PRIOR)
    assert robot.answer(PriorSource.PRIOR, FAR) == Judgement(Decision.PUBLISH)


def test_without_answers_it_coasts_and_is_lost():
    robot = Robot(coast_after=1.0, lost_after=15.0)
    robot.answer(PriorSource.PRIOR)
    robot.wait(0.9)
    assert robot.fail(PriorSource.LAST_ANSWER).decision is Decision.CARRY_ON
    assert robot.now is State.LOCALIZED
    robot.wait(0.2)
    robot.fail(PriorSource.LAST_ANSWER)
    assert robot.now is State.COASTING
    robot.wait(13.8)
    assert robot.fail(PriorSource.LAST_ANSWER).decision is Decision.CARRY_ON
    robot.wait(0.2)
    assert robot.fail(PriorSource.LAST_ANSWER).decision is Decision.FORGET
    standing = robot.state.standing()
    assert (standing.state, standing.reason, standing.failures) == (State.LOST, "no answer for 15.1 s", 4)
    robot.wait(2.0)
    assert robot.state.standing().seconds == pytest.approx(2.0)


def test_an_answer_ends_coasting():
    robot = Robot()
    robot.answer(PriorSource.PRIOR)
    robot.wait(2.0)
    robot.fail(PriorSource.LAST_ANSWER)
    robot.answer(PriorSource.LAST_ANSWER, NEAR)
    assert robot.now is State.LOCALIZED
    assert robot.state.failures == 0


def test_time_alone_coasts_and_loses_where_images_ought_to_come():
    for wanted, expected in ((True, State.LOST), (False, State.COASTING)):
        robot = Robot()
        robot.answer(PriorSource.PRIOR)
        robot.wait(2.1)
        robot.state.pass_time(None, wanted)
        assert robot.now is State.COASTING
        robot.wait(20.0)
        robot.state.pass_time(None, wanted)
        assert robot.now is expected


def test_odometry_carries_for_as_long_as_it_is_good():
    robot = Robot(lost_distance=5.0)
    robot.answer(PriorSource.PRIOR)
    robot.wait(1000.0)
    robot.state.pass_time(4.9, True)
    assert robot.now is State.COASTING
    robot.state.pass_time(5.1, True)
    standing = robot.state.standing()
    assert standing.state is State.LOST
    assert standing.reason == "the position is uncertain by 5.1 (search.lost_distance)"


@given(sigma=st.floats(0.01, 100.0), source=st.sampled_from([None, *PriorSource]))
def test_only_an_own_answer_is_outgrown(sigma, source):
    robot = Robot(lost_distance=5.0)
    robot.answer(PriorSource.PRIOR)
    outgrown = robot.state.outgrown(source, np.diag([sigma**2] * 6))
    assert outgrown == (source in OWN and sigma > 5.0)
    assert robot.now is (State.LOST if outgrown else State.LOCALIZED)


def test_reset_is_lost_at_once():
    robot = Robot()
    robot.answer(PriorSource.PRIOR)
    robot.state.reset("asked for")
    standing = robot.state.standing()
    assert (standing.state, standing.reason, robot.state.resets) == (State.LOST, "asked for", 1)
    assert robot.answer(None).decision is Decision.AWAIT


def test_a_clock_that_goes_back_does_no_harm():
    robot = Robot()
    robot.answer(PriorSource.PRIOR)
    robot.wait(-100.0)
    robot.fail(PriorSource.LAST_ANSWER)
    assert robot.state.standing().seconds == 0.0
    assert robot.now is State.LOCALIZED


events = st.lists(
    st.tuples(
        st.sampled_from(["answer", "fail", "time", "reset"]),
        st.sampled_from([None, *PriorSource]),
        st.sampled_from([HERE, NEAR, FAR]),
        st.booleans(),
        st.floats(0.0, 10.0),
    ),
    max_size=30,
)


@given(events=events, confirm=st.integers(0, 3))
def test_whatever_happens(events, confirm):
    """LOCALIZED only by a published answer; LOST left only so; nothing unattested published without so many images."""
    robot = Robot(confirm=confirm)
    agreeing = 0
    for kind, source, pose, confirmable, seconds in events:
        before = robot.now
        robot.wait(seconds)
        if kind == "answer":
            decision = robot.answer(source, pose, confirmable).decision
            assert decision in (Decision.PUBLISH, Decision.AWAIT)
            assert (decision is Decision.PUBLISH) <= (robot.now is State.LOCALIZED)
            if decision is Decision.AWAIT:
                assert robot.now is before
                assert confirmable
            if source is PriorSource.UNCONFIRMED:
                agreeing = agreeing + 1 if pose is not FAR else 0
                assert (decision is Decision.PUBLISH) == (not confirmable or agreeing >= confirm)
            if decision is Decision.PUBLISH or source is not PriorSource.UNCONFIRMED:
                agreeing = 0
        elif kind == "fail":
            assert robot.fail(source).decision in (Decision.CARRY_ON, Decision.FORGET)
        elif kind == "time":
            robot.state.pass_time(None, confirmable)
        else:
            robot.state.reset("asked for")
            agreeing = 0
        if kind != "answer":
            assert robot.now is not State.LOCALIZED or before is State.LOCALIZED
            assert before is not State.LOST or robot.now is State.LOST


# How uncertain a pose becomes.

seconds = st.floats(0.0, 1e4)


@given(first=seconds, second=seconds, planar=st.booleans())
def test_uncertainty_grows_with_time(first, second, planar):
    sigmas = []
    for age in sorted((first, second)):
        grown = GrowthOptions().by_time(age).added_to(COVARIANCE, planar)
        sigmas.append((position_sigma(grown), rotation_sigma(grown)))
    assert sigmas[0] <= sigmas[1]
    assert sigmas[1][0] >= 0.999 * GrowthOptions().max_speed * max(first, second)


def test_uncertainty_grows_with_the_way_by_odometry():
    growth = GrowthOptions(odometry_distance_error=0.1, odometry_turn_error=0.2).by_odometry(Travelled(30.0, 2.0))
    assert growth == Growth(3.0, 0.4)
    grown = growth.added_to(np.zeros((6, 6)), False)
    np.testing.assert_allclose(np.sqrt(grown.diagonal()), [3.0, 3.0, 3.0, 0.4, 0.4, 0.4])


def test_a_planar_robot_stays_on_its_plane():
    grown = Growth(3.0, 0.4).added_to(COVARIANCE, True)
    kept = [2, 3, 4]
    np.testing.assert_array_equal(grown.diagonal()[kept], COVARIANCE.diagonal()[kept])
    assert (grown.diagonal()[[0, 1, 5]] > COVARIANCE.diagonal()[[0, 1, 5]]).all()


def test_options_may_be_replaced():
    robot = Robot()
    robot.state.options = replace(robot.state.options, confirm=0)
    assert robot.answer(None).decision is Decision.PUBLISH
