"""The node's watch over its own answers: what odometry says of them, in words."""

from __future__ import annotations

import re

import numpy as np
import pytest
from checked_drives import ANSWER, T_BODY_CAMERA, planar, straight
from ros_messages import header, odometry

from gsfeatloc_ros.common.geometry import isotropic_covariance, make_pose, so3_exp
from gsfeatloc_ros.crosscheck.fit import Cause
from gsfeatloc_ros.ros_io.cross_check import CrossCheck, CrossCheckOptions
from gsfeatloc_ros.ros_io.inputs import Inputs, InputTopic
from gsfeatloc_ros.ros_io.prior import PriorPolicy


class Robot:
    """Drives, and takes a photo twice a second whose answer and odometry are without errors but for what is wrong."""

    def __init__(self, answers: int = 20, scale: float = 1.0, mounting: np.ndarray = T_BODY_CAMERA) -> None:
        def lookup(target: str, source: str, stamp: int) -> np.ndarray:
            if (target, source) != ("base_link", "camera"):
                raise ValueError(f"no way from {source} to {target}")
            return mounting

        self.inputs = Inputs(PriorPolicy(), lookup, False, "no camera_info yet")
        self.check = CrossCheck(self.inputs, CrossCheckOptions(answers), scale)
        self.time = 100.0

    def drive(self, path, answers: int, scale: float = 1.0, delay: float = 0.0, frame: str = "camera") -> None:
        for _ in range(answers):
            for step in range(25):
                moment = self.time + 0.02 * step
                self.inputs.take(InputTopic.ODOMETRY, odometry(moment, path(moment)))
            self.time += 0.5
            # It comes later than the odometry.
            stamp = self.time - 0.02
            T_map_camera = path(stamp - delay) @ T_BODY_CAMERA
            T_map_camera[:3, 3] *= scale
            self.check.take(header(stamp, frame), T_map_camera, isotropic_covariance(*ANSWER))


def test_nothing_is_known_before_an_answer():
    check = Robot().check
    assert (check.cause, check.warning) == (None, "")
    assert check.texts() == {"odometry_says": "", "odometry_answers": "0", "odometry_noise": "nan"}


def test_without_odometry_or_tf_answers_do_not_count():
    robot = Robot()
    robot.check.take(header(1.0, "camera"), np.eye(4), np.eye(6))
    robot.drive(planar, 10, frame="another")
    assert robot.check.texts()["odometry_answers"] == "0"


def test_all_is_right():
    robot = Robot()
    robot.drive(planar, 45)
    assert robot.check.warning == ""
    assert robot.check.texts()["odometry_answers"] == "40"


def test_a_robot_that_stands_still_says_nothing():
    robot = Robot()
    robot.drive(lambda time: planar(0.0), 45, scale=1.3)
    assert robot.check.warning == ""
    assert robot.check.texts()["odometry_answers"] == "1"


def test_a_wrong_scale_is_named_with_the_one_to_set_after_twenty_answers_and_no_more_with_another_map():
    robot = Robot(scale=2.0)
    robot.drive(planar, 19, scale=1.3)
    assert robot.check.cause is None
    robot.drive(planar, 8, scale=1.3)
    assert robot.check.cause is Cause.SCALE
    said = robot.check.warning.split()
    assert said[:3] == ["odometry", "says", "map.scale"]
    assert said[-2:] == ["not", "2"]
    assert float(said[3]) == pytest.approx(2.0 / 1.3, rel=0.01)
    robot.check.forget()  # the robot was carried
    assert robot.check.cause is Cause.SCALE
    assert robot.check.texts()["odometry_answers"] == "0"
    robot.check.reset()
    assert robot.check.warning == ""


@pytest.mark.parametrize(("delay", "says"), [(0.08, r"0.080 \+- 0.00\d s late: take"), (-0.05, r"0.050 .* early: add")])
def test_images_that_are_stamped_late_or_early(delay, says):
    robot = Robot()
    robot.drive(planar, 30, delay=delay)
    assert re.search(says, robot.check.warning), robot.check.warning


def test_a_camera_that_is_elsewhere_on_a_robot_on_the_floor():
    robot = Robot(mounting=make_pose(T_BODY_CAMERA[:3, :3], T_BODY_CAMERA[:3, 3] - [0.05, 0.0, 0.0]))
    robot.drive(planar, 30)
    assert re.fullmatch(
        r"odometry says that the camera is 0.0[45]\d \+- 0.00\d m further forward \(x 0.(19|20)\d, not 0.150\) on "
        "base_link than tf says; of z this drive tells nothing",
        robot.check.warning,
    ), robot.check.warning


def test_a_camera_that_is_turned():
    robot = Robot(mounting=make_pose(so3_exp(np.array([0.0, 0.05, 0.0])) @ T_BODY_CAMERA[:3, :3], T_BODY_CAMERA[:3, 3]))
    robot.drive(planar, 30)
    assert re.match(
        r"odometry says that the camera is turned on base_link by pitch -2.\d \+- 0.\d degrees against what tf says",
        robot.check.warning,
    ), robot.check.warning


def test_twenty_is_a_parameter_and_none_means_never():
    robot = Robot(answers=0)
    robot.drive(straight, 30, scale=1.3)
    assert robot.check.texts()["odometry_answers"] == "0"


def test_a_robot_that_is_carried_begins_anew():
    robot = Robot()
    robot.drive(planar, 15)
    robot.drive(lambda time: make_pose(np.eye(3), [9.0, 0.0, 0.0]) @ planar(time), 1)
    assert robot.check.warning == ""


def test_what_goes_wrong_later_is_found_as_well():
    robot = Robot()
    robot.drive(planar, 45)
    assert robot.check.warning == ""
    robot.drive(planar, 40, delay=0.08)
    assert robot.check.cause is Cause.DELAY
    robot.drive(planar, 50)
    assert robot.check.warning == ""
