"""What replay says at the end, and which way is up in its picture."""

from __future__ import annotations

import numpy as np
import pytest

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.replay.figure import up_axis
from gsfeatloc_ros.replay.summary import counted_reasons


def test_reasons_that_differ_only_in_numbers_are_counted_together():
    reasons = [f"prior is {age:.1f} s newer than the image (at most 10, 1e-3)" for age in (2.5, 30.25, -7)]
    assert counted_reasons(["too dark", *reasons]) == [f"    3 x such as: {reasons[0]}", "    1 x too dark"]


def test_alike_reasons_are_no_example():
    assert counted_reasons(["4 of 5"] * 2) == ["    2 x 4 of 5"]


def test_of_many_reasons_the_most_frequent_are_named():
    reasons = [letter for number, letter in enumerate("abcdefg", start=1) for _ in range(number)]
    assert counted_reasons(reasons) == [f"    {7 - n} x {letter}" for n, letter in enumerate("gfedc")] + ["    ..."]


@pytest.mark.parametrize(
    ("up", "axis"), [([0, 0, 1], 2), ([0, -1, 0], 1), ([0, 1, 0], 1), ([1, 0, 0], 0), ([0.1, -0.9, 0.3], 1)]
)
def test_up_is_where_the_cameras_say(up, axis):
    """Cameras that look all round, tilted a little, with y down."""
    down = -np.array(up, float) / np.linalg.norm(up)
    ahead = np.cross(down, [0.6, 0.64, 0.48])
    ahead /= np.linalg.norm(ahead)
    upright = np.column_stack([np.cross(down, ahead), down, ahead])
    turns = [so3_exp(angle * down) @ upright @ so3_exp(np.array([0.2, 0, 0.1])) for angle in np.linspace(0, 6, 20)]
    assert up_axis(np.array([make_pose(turn, np.zeros(3)) for turn in turns])) == axis


def test_without_cameras_z_is_up():
    assert up_axis(np.empty((0, 4, 4))) == 2
