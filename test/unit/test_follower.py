"""A robot that is followed from image to image: what each starts from, and what becomes of its answer."""

from __future__ import annotations

import numpy as np
import pytest
from ros_messages import SECOND, camera_info, image, odometry, prior

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.localize.evidence import Evidence
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.ros_io.follower import Follower
from gsfeatloc_ros.ros_io.inputs import Inputs, InputTopic
from gsfeatloc_ros.ros_io.prior import PriorPolicy, PriorSource, decode_prior
from gsfeatloc_ros.ros_io.state import Decision, LocalizationState, State, StateOptions


def along(distance: float) -> np.ndarray:
    return make_pose(np.eye(3), [0.0, 0.0, distance])


class Robot:
    """A camera that moves ahead at 1 m/s, and whose images are taken at the time of their stamps."""

    def __init__(self, track: bool = True, has_odometry: bool = True) -> None:
        self.time = 100 * SECOND
        self.inputs = Inputs(PriorPolicy(), lambda target, source, at: np.eye(4), False, "no camera_info yet")
        self.inputs.take(InputTopic.CAMERA_INFO, camera_info())
        self.follower = Follower(self.inputs, LocalizationState(StateOptions(), lambda: self.time), track)
        self.speed, self.searched = 1.0, 0
        self._driven = 99.0 if has_odometry else np.inf

    def drive(self, seconds: float) -> None:
        """Go on up to a time."""
        self.time = round(seconds * SECOND)
        while self._driven <= seconds:
            self.inputs.take(InputTopic.ODOMETRY, odometry(self._driven, along(self.speed * self._driven), "camera"))
            self._driven += 0.1

    def see(self, seconds: float, pose: np.ndarray | None) -> tuple[PriorSource | None, Decision]:
        """What an image is localized with, and what is to be done, where this is the answer."""
        self.drive(seconds)
        query = self.follower.for_image(image(seconds))
        status = Status.FAILED if pose is None else Status.LOCALIZED
        estimate = Estimate(status, "", pose, evidence=Evidence(searched=self.searched, index_views=250))
        decision = self.follower.take(query, image(seconds).header, estimate).decision
        return query.source, decision

    def ask(self, seconds: float, pose: np.ndarray, frame: str = "camera", with_prior: bool = False) -> None:
        """Have an image that came with a request answered by this."""
        self.drive(seconds)
        message = image(seconds, frame)
        own = decode_prior(prior(seconds, pose), PriorSource.REQUEST, self.inputs.policy) if with_prior else None
        query = self.follower.for_image(message, prior=own)
        self.follower.take_requested(query, message.header, pose)

    @property
    def state(self) -> State:
        return self.follower.state.standing().state


def test_found_without_a_prior_and_followed():
    robot = Robot()
    assert robot.see(100, along(0)) == (None, Decision.AWAIT)
    assert robot.state is State.LOST
    assert robot.see(101, along(1)) == (PriorSource.UNCONFIRMED, Decision.PUBLISH)
    assert robot.see(102, along(2)) == (PriorSource.LAST_ANSWER, Decision.PUBLISH)
    robot.drive(104)
    query = robot.follower.for_image(image(104))
    np.testing.assert_allclose(query.T_map_camera_prior, along(4), atol=1e-9)
    # It may be anywhere near, but is by 2 metres of odometry, of which a tenth may be wrong, from an answer.
    usual = robot.follower.options(LocalizerOptions(), image(104).header, query).search.usual_covariance
    assert np.sqrt(usual[0, 0]) == pytest.approx(np.hypot(0.003, 0.2))
    assert query.prior_covariance[0, 0] > usual[0, 0]


def test_how_far_off_a_prior_from_outside_usually_is_its_covariance_says():
    robot = Robot()
    robot.inputs.take(InputTopic.PRIOR, prior(100.0, along(0)))
    query = robot.follower.for_image(image(100))
    assert query.source is PriorSource.PRIOR
    assert query.usual_covariance is None


def skipped(robot: Robot, seconds: float) -> int:
    """How many views of the index an image leaves out."""
    robot.drive(seconds)
    query = robot.follower.for_image(image(seconds))
    return robot.follower.options(LocalizerOptions(), image(seconds).header, query).search.skipped


def test_a_robot_that_stands_looks_at_other_views_each_time() -> None:
    robot = Robot()
    robot.speed, robot.searched = 0.0, 100
    expected = [0, 100, 200, 0, 100]  # of 250
    for seconds, left_out in enumerate(expected, start=100):
        assert skipped(robot, seconds) == left_out
        robot.see(seconds, None)
    robot.see(105, along(0))
    assert skipped(robot, 106) == 0


@pytest.mark.parametrize("how", ["it moves", "it turns", "nobody knows"])
def test_a_robot_that_may_have_moved_looks_at_the_likeliest_views(how: str) -> None:
    robot = Robot(has_odometry=how != "nobody knows")
    robot.speed, robot.searched = float(how == "it moves"), 100
    robot.see(100, None)
    if how == "it turns":
        robot.drive(101)
        turned = make_pose(so3_exp(np.array([0.0, 0.1, 0.0])), np.zeros(3))
        robot.inputs.take(InputTopic.ODOMETRY, odometry(101.3, turned, "camera"))
    assert skipped(robot, 100.1) == 0 if how == "nobody knows" else skipped(robot, 100.1) == 100
    assert skipped(robot, 101.3) == 0


def test_without_odometry_it_is_found_at_once():
    robot = Robot(has_odometry=False)
    assert robot.see(100, along(0)) == (None, Decision.PUBLISH)
    assert robot.see(101, along(1)) == (PriorSource.LAST_ANSWER, Decision.PUBLISH)


def test_without_track_each_image_is_found_by_itself():
    robot = Robot(track=False)
    for seconds in range(100, 103):
        assert robot.see(seconds, along(0)) == (None, Decision.PUBLISH)


def test_where_images_only_come_when_asked_for_nothing_is_awaited():
    robot = Robot()
    robot.follower.images_come = False
    assert robot.see(100, along(0)) == (None, Decision.PUBLISH)


def test_a_covered_lens():
    """Odometry goes on: it is found where it carried the last answer, however long ago that was."""
    robot = Robot()
    robot.inputs.take(InputTopic.PRIOR, prior(100, along(0)))
    robot.see(100, along(0))
    for seconds in range(101, 112):
        assert robot.see(seconds, None) == (PriorSource.LAST_ANSWER, Decision.CARRY_ON)
    assert robot.state is State.COASTING
    assert robot.see(112, along(12)) == (PriorSource.LAST_ANSWER, Decision.PUBLISH)
    assert robot.state is State.LOCALIZED


def test_a_covered_lens_without_odometry():
    """After seconds at a speed that is possible it may be anywhere."""
    robot = Robot(has_odometry=False)
    robot.inputs.take(InputTopic.PRIOR, prior(100, along(0)))
    robot.see(100, along(0))
    sources = [robot.see(seconds, None)[0] for seconds in range(101, 112)]
    lost = sources.index(None)
    assert sources == [PriorSource.LAST_ANSWER] * lost + [None] * (11 - lost)
    assert lost == 4
    assert robot.state is State.LOST
    assert robot.see(112, along(12)) == (None, Decision.PUBLISH)


def test_long_in_vain_with_good_odometry():
    robot = Robot()
    robot.inputs.take(InputTopic.PRIOR, prior(100, along(0)))
    robot.see(100, along(0))
    for seconds in range(101, 117):
        robot.see(seconds, None)
    assert robot.state is State.LOST
    assert robot.see(117, None) == (None, Decision.FORGET)


def test_carried_off():
    robot = Robot()
    robot.inputs.take(InputTopic.PRIOR, prior(100, along(0)))
    robot.see(100, along(0))
    elsewhere = make_pose(np.eye(3), [20.0, 0.0, 0.0])
    assert robot.see(101, elsewhere @ along(1)) == (PriorSource.LAST_ANSWER, Decision.AWAIT)
    assert robot.state is State.LOCALIZED
    assert robot.see(102, elsewhere @ along(2)) == (PriorSource.UNCONFIRMED, Decision.PUBLISH)


def test_the_answer_to_a_request_heals_the_stream():
    robot = Robot()
    robot.ask(100, along(0), with_prior=True)
    assert robot.see(101, along(1)) == (PriorSource.LAST_ANSWER, Decision.PUBLISH)


def test_without_a_prior_the_answer_to_a_request_is_confirmed_by_the_stream():
    robot = Robot()
    robot.ask(100, along(0))
    assert robot.state is State.LOST
    assert robot.see(101, along(1)) == (PriorSource.UNCONFIRMED, Decision.PUBLISH)


def test_a_request_of_another_camera_or_time_does_not_touch_the_stream():
    robot = Robot()
    robot.inputs.take(InputTopic.PRIOR, prior(100, along(0)))
    robot.see(100, along(0))
    robot.ask(101, along(50), frame="other_camera", with_prior=True)
    robot.ask(99, along(50), with_prior=True)
    robot.drive(102)
    np.testing.assert_allclose(robot.follower.for_image(image(102)).T_map_camera_prior, along(2), atol=1e-9)


@pytest.mark.parametrize("with_priors", [True, False])
def test_lost_on_demand(with_priors):
    robot = Robot()
    robot.inputs.take(InputTopic.PRIOR, prior(100, along(0)))
    robot.follower.lose("asked for", with_priors=with_priors)
    assert robot.state is State.LOST
    assert robot.follower.for_image(image(100)).source is (None if with_priors else PriorSource.PRIOR)
    robot.see(100, along(0))
    robot.follower.lose("asked for", with_priors=with_priors)
    assert robot.follower.for_image(image(100)).source is None


def test_time_passes_by_odometry_without_images():
    robot = Robot()
    robot.inputs.take(InputTopic.PRIOR, prior(100, along(0)))
    robot.see(100, along(0))
    robot.drive(140)
    robot.follower.pass_time(images_wanted=False)
    assert robot.state is State.COASTING
    robot.drive(160)
    robot.follower.pass_time(images_wanted=False)
    assert robot.state is State.LOST


def test_once_the_focal_length_is_known_an_image_need_not_show_it():
    robot = Robot()
    flat = Evidence(inliers=100, focal_error=0.0, focal_sigma=0.003)

    def limit(seconds: float) -> float:
        query = robot.follower.for_image(image(seconds))
        return robot.follower.options(LocalizerOptions(), image(seconds).header, query).limits.max_focal_error

    robot.drive(100)
    assert limit(100) == LocalizerOptions().limits.max_focal_error
    for seconds in range(100, 115):
        robot.drive(seconds)
        query = robot.follower.for_image(image(seconds))
        answer = Estimate(Status.LOCALIZED, "", along(seconds), np.eye(6), evidence=flat)
        robot.follower.take(query, image(seconds).header, answer)
    assert limit(115) == 1.0
