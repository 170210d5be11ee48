"""SE(3), quaternions and pose errors, against the definitions: power series, cross and quaternion products."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gsfeatloc_ros.common.geometry import (
    invert,
    make_pose,
    matrix_from_quaternion,
    moved,
    pose_from_numbers,
    quaternion_from_matrix,
    random_unit_vector,
    rotation_error_deg,
    skew,
    so3_exp,
    so3_log,
    transform,
    translation_error,
)

vectors = arrays(np.float64, 3, elements=st.floats(-10, 10))
unit_vectors = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3).map(lambda v: v / np.linalg.norm(v))
# The two ends of the range as well as its middle: the closed forms change there.
angles = st.one_of(
    st.floats(0, np.pi),
    st.floats(-12, -3).map(lambda e: 10.0**e),
    st.floats(-12, -3).map(lambda e: np.pi - 10.0**e),
    st.sampled_from([0.0, np.pi]),
)
rotation_vectors = st.builds(lambda axis, angle: axis * angle, unit_vectors, angles)
rotations = rotation_vectors.map(so3_exp)
poses = st.builds(make_pose, rotations, vectors)
quaternions = arrays(np.float64, 4, elements=st.floats(-10, 10)).filter(lambda q: np.linalg.norm(q) > 1e-3)


def exponential(matrix: np.ndarray) -> np.ndarray:
    """Matrix exponential by its definition, the power series."""
    total, term = np.eye(3), np.eye(3)
    for k in range(1, 60):
        term = term @ matrix / k
        total = total + term
    return total


@given(vectors, vectors)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


def test_skew_of_many_and_of_none():
    many = np.random.default_rng(0).normal(size=(5, 2, 3))
    np.testing.assert_array_equal(skew(many)[3, 1], skew(many[3, 1]))
    assert skew(np.zeros((0, 3))).shape == (0, 3, 3)


@given(rotation_vectors)
def test_so3_exp_is_the_matrix_exponential(rotation_vector):
    np.testing.assert_allclose(so3_exp(rotation_vector), exponential(skew(rotation_vector)), atol=1e-12)


@given(rotations)
def test_so3_exp_is_a_rotation(rotation):
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0


@given(unit_vectors, angles)
def test_so3_log_inverts_exp(axis, angle):
    rotation = so3_exp(angle * axis)
    rotation_vector = so3_log(rotation)
    assert np.linalg.norm(rotation_vector) == pytest.approx(angle, abs=1e-9)
    # At half a turn the axis has two directions: the rotation is what must agree.
    np.testing.assert_allclose(so3_exp(rotation_vector), rotation, atol=1e-9)


@given(unit_vectors, angles.filter(lambda angle: angle < 3.0))
def test_so3_log_gives_the_rotation_vector(axis, angle):
    np.testing.assert_allclose(so3_log(so3_exp(angle * axis)), angle * axis, atol=1e-9)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3)]))
def test_half_turns_about_the_axes(axis):
    rotation = 2 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(abs(so3_log(rotation)), np.pi * abs(axis), atol=1e-12)


@given(quaternions)
def test_quaternion_and_matrix_round_trip(quaternion):
    unit = quaternion / np.linalg.norm(quaternion)
    again = quaternion_from_matrix(matrix_from_quaternion(quaternion))
    assert again[3] >= 0
    assert abs(again @ unit) == pytest.approx(1, abs=1e-12)  # q and -q are one rotation


@given(quaternions, vectors)
def test_matrix_turns_as_the_quaternion_does(quaternion, point):
    # q p q* with the vector part u and the scalar w: p + 2 u x (u x p + w p).
    *u, w = quaternion / np.linalg.norm(quaternion)
    turned = point + 2 * np.cross(u, np.cross(u, point) + w * point)
    np.testing.assert_allclose(matrix_from_quaternion(quaternion) @ point, turned, atol=1e-9)


@given(rotation_vectors)
def test_quaternion_holds_half_the_angle(rotation_vector):
    angle = np.linalg.norm(rotation_vector)
    assume(angle > 1e-6)
    expected = np.append(np.sin(angle / 2) * rotation_vector / angle, np.cos(angle / 2))
    assert abs(quaternion_from_matrix(so3_exp(rotation_vector)) @ expected) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1], [1e-12, 0, 0, 0]])
def test_quaternion_without_a_direction_is_refused(quaternion):
    with pytest.raises(ValueError, match="no direction"):
        matrix_from_quaternion(quaternion)


@given(poses)
def test_inverse(pose):
    np.testing.assert_allclose(invert(pose) @ pose, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(invert(pose), np.linalg.inv(pose), atol=1e-9)


@given(poses, poses, arrays(np.float64, (4, 3), elements=st.floats(-10, 10)))
def test_transform_composes(T_a_b, T_b_c, points):
    np.testing.assert_allclose(transform(T_a_b, transform(T_b_c, points)), transform(T_a_b @ T_b_c, points), atol=1e-9)


def test_transform_of_no_points():
    assert transform(np.eye(4), np.zeros((0, 3))).shape == (0, 3)


@given(poses, rotation_vectors, vectors)
def test_pose_errors_are_those_put_in(pose, rotation_vector, translation):
    other = make_pose(pose[:3, :3] @ so3_exp(rotation_vector), pose[:3, 3] + translation)
    expected = np.degrees(np.linalg.norm(rotation_vector))
    assert rotation_error_deg(pose, other) == pytest.approx(expected, abs=1e-6)
    assert rotation_error_deg(other, pose) == pytest.approx(expected, abs=1e-6)
    assert translation_error(pose, other) == pytest.approx(np.linalg.norm(translation), abs=1e-9)


@given(poses)
def test_a_pose_has_no_error_to_itself(pose):
    assert rotation_error_deg(pose, pose) == pytest.approx(0, abs=1e-6)
    assert translation_error(pose, pose) == 0


def test_random_unit_vectors_are_uniform():
    rng = np.random.default_rng(0)
    directions = np.array([random_unit_vector(rng) for _ in range(5000)])
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    # Archimedes: each coordinate of a uniform direction is uniform in [-1, 1], of mean 0 and variance 1/3.
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=4 * np.sqrt(1 / 3 / 5000))
    np.testing.assert_allclose(directions.T @ directions / 5000, np.eye(3) / 3, atol=0.03)


@given(poses, arrays(np.float64, 6, elements=st.floats(-3, 3)))
def test_a_step_moves_in_the_frame_and_turns_on_the_left(pose, step):
    turned = make_pose(exponential(skew(step[3:])), np.zeros(3)) @ make_pose(pose[:3, :3], np.zeros(3))
    turned[:3, 3] = pose[:3, 3] + step[:3]
    np.testing.assert_allclose(moved(pose, step), turned, atol=1e-9)


@given(vectors, quaternions)
def test_a_pose_is_seven_numbers(translation, quaternion):
    pose = pose_from_numbers([*translation, *quaternion])
    np.testing.assert_array_equal(pose[:3, 3], translation)
    np.testing.assert_array_equal(pose[:3, :3], matrix_from_quaternion(quaternion))


@pytest.mark.parametrize(
    "numbers", [[], [0.0] * 6, [0.0] * 7, [np.nan, 0, 0, 0, 0, 0, 1], [np.inf, 0, 0, 0, 0, 0, 1], [1.0] * 8]
)
def test_other_numbers_are_no_pose(numbers):
    with pytest.raises(ValueError, match=r"seven finite numbers|no direction"):
        pose_from_numbers(numbers)
