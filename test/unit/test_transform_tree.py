"""The tree of transforms answers as tf2 does."""

from __future__ import annotations

import numpy as np
import pytest
from bags import transform
from hypothesis import given, settings
from hypothesis import strategies as st

from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp
from gsfeatloc_ros.ros_io.transform_tree import TransformError, TransformTree

SECOND = 10**9


def turned(angle: float, *position: float) -> np.ndarray:
    return make_pose(so3_exp(np.array([0.0, 0.0, angle])), position)


@pytest.fixture
def tree() -> TransformTree:
    """map -> odom -> base, which move, and base -> camera, which does not; and another tree."""
    tree = TransformTree()
    for stamp in (1.0, 2.0, 3.0):
        tree.take(transform(stamp, "map", "odom", turned(0.1, 1, 0, 0)), static=False)
        tree.take(transform(stamp, "/odom", "base", turned(0.2 * stamp, stamp, 0, 0)), static=False)
    tree.take(transform(2.5, "base", "/camera", turned(0, 0, 0, 1)), static=True)
    tree.take(transform(1.0, "other", "left", turned(0, 0, 0, 0)), static=True)
    return tree


@pytest.mark.parametrize("stamp", [1.0, 1.5, 2.0, 2.9, 3.0])
def test_between_two_times_it_goes_straight_and_turns_evenly(tree, stamp):
    expected = turned(0.1, 1, 0, 0) @ turned(0.2 * stamp, stamp, 0, 0) @ turned(0, 0, 0, 1)
    found = tree.lookup("map", "camera", int(stamp * SECOND))
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(tree.lookup("camera", "map", int(stamp * SECOND)), invert(expected), atol=1e-9)


def test_without_a_time_it_is_the_newest_that_all_have(tree):
    tree.take(transform(4.0, "odom", "base", turned(0, 9, 0, 0)), static=False)
    expected = turned(0.1, 1, 0, 0) @ turned(0.6, 3, 0, 0)
    np.testing.assert_allclose(tree.lookup("map", "base", 0), expected, atol=1e-9)
    np.testing.assert_allclose(tree.lookup("odom", "base", 0), turned(0, 9, 0, 0), atol=1e-9)


@pytest.mark.parametrize(
    ("target", "source", "stamp", "why"),
    [
        ("map", "camera", 0.5, "into the past"),
        ("map", "camera", 3.5, "into the future"),
        ("map", "left", 2.0, "not part of the same tree"),
        ("map", "nobody", 2.0, "not part of the same tree"),
    ],
)
def test_what_is_not_known_is_named(tree, target, source, stamp, why):
    with pytest.raises(TransformError, match=f"no transform from '{source}' to '{target}' at .*{why}"):
        tree.lookup(target, source, int(stamp * SECOND))


def test_a_frame_is_where_it_is_in_itself():
    np.testing.assert_array_equal(TransformTree().lookup("nobody", "nobody", 5), np.eye(4))


def test_loops_end(tree):
    tree.take(transform(2.0, "camera", "map", turned(0, 0, 0, 0)), static=True)
    with pytest.raises(TransformError, match="loop"):
        tree.lookup("left", "camera", 0)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_what_tf2_ignores_is_ignored(tree, wrong):
    tree.take(transform(4.0, "odom", "base", turned(0, wrong, 0, 0)), static=False)
    tree.take(transform(4.0, "base", "base", turned(0, 0, 0, 0)), static=False)
    tree.take(transform(4.0, "", "base", turned(0, 0, 0, 0)), static=False)
    np.testing.assert_allclose(tree.lookup("odom", "base", 0), turned(0.6, 3, 0, 0), atol=1e-9)


def test_another_parent_takes_the_place_of_the_old_one(tree):
    tree.take(transform(1.0, "left", "camera", turned(0, 0, 0, 2)), static=True)
    np.testing.assert_allclose(tree.lookup("other", "camera", 0), turned(0, 0, 0, 2), atol=1e-9)


@settings(max_examples=20)
@given(st.lists(st.integers(0, 20), min_size=1))
def test_the_order_of_messages_does_not_matter_within_what_is_kept(seconds):
    tree = TransformTree()
    newest = 0
    for second in seconds:
        newest = max(newest, second)
        tree.take(transform(float(second), "odom", "base", turned(0, second, 0, 0)), static=False)
    for second in {second for second in seconds if second >= newest - 10}:
        if second:  # 0 is no time
            assert tree.lookup("odom", "base", second * SECOND)[0, 3] == second
