"""How the robot has moved, from its odometry."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp
from gsfeatloc_ros.ros_io import odometry as odometry_module
from gsfeatloc_ros.ros_io.odometry import OdometryBuffer

SECOND = 1_000_000_000


def on_a_circle(seconds: float) -> np.ndarray:
    """Pose of a robot that drives at 1 m/s and turns by 0.5 rad/s: a screw motion, so the same in equal times."""
    angle = 0.5 * seconds
    return make_pose(so3_exp(np.array([0, 0, angle])), [2 * np.sin(angle), 2 * (1 - np.cos(angle)), 0.0])


def filled(start: float, end: float, period: float = 0.05) -> OdometryBuffer:
    odometry = OdometryBuffer(60.0)
    for step in range(round((end - start) / period) + 1):
        seconds = start + step * period
        odometry.add(round(seconds * SECOND), on_a_circle(seconds))
    return odometry


def test_nothing_is_known_without_odometry():
    assert OdometryBuffer(60.0).between(0, SECOND) is None


@given(start=st.floats(100.0, 110.0), end=st.floats(100.0, 110.0))
def test_motion_between_any_two_times(start, end):
    motion = filled(100.0, 110.0).between(round(start * SECOND), round(end * SECOND)).motion
    expected = invert(on_a_circle(start)) @ on_a_circle(end)
    # A chord of the circle is 0.3 mm from the arc at most: 0.05 s are 0.025 rad at a radius of 2 m.
    assert np.abs(motion - expected).max() < 4e-4


@given(seconds=st.floats(100.0, 110.1))
def test_velocity_at_any_time_and_a_little_later(seconds):
    velocity = filled(100.0, 110.0).velocity(round(seconds * SECOND))
    # In its own axes the robot drives straight on; the chord is to the side by half of the turn between two poses.
    np.testing.assert_allclose(velocity, [1, 0, 0, 0, 0, 0.5], atol=0.013)


@pytest.mark.parametrize("outside", [99.7, 110.3])
def test_velocity_is_not_known_outside_of_what_came(outside):
    assert OdometryBuffer(60.0).velocity(0) is None
    assert filled(100.0, 100.0).velocity(100 * SECOND) is None
    assert filled(100.0, 110.0).velocity(round(outside * SECOND)) is None


@pytest.mark.parametrize("outside", [99.7, 110.3])
def test_nothing_is_known_outside_of_what_came(outside):
    odometry = filled(100.0, 110.0)
    assert odometry.between(round(outside * SECOND), 105 * SECOND) is None
    assert odometry.between(105 * SECOND, round(outside * SECOND)) is None


def test_a_little_beyond_the_newest_the_robot_is_taken_to_be_there():
    odometry = filled(100.0, 110.0)
    motion = odometry.between(105 * SECOND, round(110.1 * SECOND)).motion
    np.testing.assert_allclose(motion, odometry.between(105 * SECOND, 110 * SECOND).motion)


def test_nothing_is_known_in_a_gap_but_beyond_it():
    odometry = filled(100.0, 102.0)
    for seconds in np.arange(105.0, 107.0, 0.05):
        odometry.add(round(seconds * SECOND), on_a_circle(seconds))
    assert odometry.between(101 * SECOND, round(103.5 * SECOND)) is None
    expected = invert(on_a_circle(101.0)) @ on_a_circle(106.0)
    np.testing.assert_allclose(odometry.between(101 * SECOND, 106 * SECOND).motion, expected, atol=1e-9)


def test_a_pose_out_of_order_is_left_out():
    odometry = filled(100.0, 101.0)
    odometry.add(round(100.53 * SECOND), make_pose(np.eye(3), [50.0, 0, 0]))
    assert np.linalg.norm(odometry.between(100 * SECOND, round(100.53 * SECOND)).motion[:3, 3]) < 1


def test_stamps_that_start_anew_replace_what_was():
    odometry = filled(100.0, 110.0)
    for seconds in (20.0, 20.05, 20.1):
        odometry.add(round(seconds * SECOND), on_a_circle(seconds))
    assert odometry.between(105 * SECOND, 106 * SECOND) is None
    assert odometry.between(20 * SECOND, round(20.1 * SECOND)) is not None


def test_what_is_later_is_forgotten():
    odometry = filled(100.0, 110.0)
    odometry.forget_after(105 * SECOND)
    assert odometry.between(102 * SECOND, 104 * SECOND) is not None
    assert odometry.between(102 * SECOND, 106 * SECOND) is None


def test_the_last_minute_is_kept_and_not_much_more():
    odometry = OdometryBuffer(1.0)
    for step in range(20000):
        odometry.add(step * SECOND // 100, np.eye(4))
    assert odometry.between(199 * SECOND, 199 * SECOND + SECOND // 2) is not None
    assert odometry.between(196 * SECOND, 199 * SECOND) is None


def test_it_may_be_filled_while_it_is_read():
    odometry, stop = filled(100.0, 110.0), threading.Event()

    def fill():
        step = 0
        while not stop.is_set():
            step += 1
            odometry.add(110 * SECOND + step * SECOND // 100, np.eye(4))

    thread = threading.Thread(target=fill)
    thread.start()
    try:
        known = [odometry.between(109 * SECOND, 110 * SECOND) is not None for _ in range(2000)]
    finally:
        stop.set()
        thread.join()
    assert known[0]


def test_it_is_bounded_by_number_whatever_stamps_say(monkeypatch):
    """A clock that hardly moves on must not fill the memory."""
    monkeypatch.setattr(odometry_module, "_MAX_KEPT", 100)
    odometry = OdometryBuffer(60.0)
    for number in range(450):
        odometry.add(SECOND + number, np.eye(4))
    assert len(odometry._stamps) == len(odometry._poses) == len(odometry._way) <= 200
    assert odometry.newest == SECOND + 449
    assert odometry.between(SECOND + 440, SECOND + 449) is not None
