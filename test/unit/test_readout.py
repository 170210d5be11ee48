"""Matches of a photo of a rolling shutter, brought to the time of its middle row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, so3_exp, transform
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.pose.readout import at_middle_row
from gsfeatloc_ros.pose.solve import Correspondences, reprojection_errors

CAMERA = Camera(640, 480, np.array([[600.0, 0, 315], [0, 610.0, 245], [0, 0, 1]]))
POSE = make_pose(so3_exp(np.array([0.4, -1.1, 0.3])), np.array([2.0, -1.0, 0.5]))


def moving(readout: ArrayLike) -> Camera:
    return replace(CAMERA, readout=np.array(readout))


def seen_while_moving(readout: np.ndarray) -> Correspondences:
    """Points that are seen at random pixels while the camera moves, each by the camera of its row."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [639, 479], (100, 2))
    in_camera = CAMERA.rays(pixels) * rng.uniform(2, 8, (100, 1))
    when = (pixels[:, 1] + 0.5) / CAMERA.height - 0.5
    points = [
        transform(POSE @ make_pose(so3_exp(s * readout[3:]), s * readout[:3]), point[None])[0]
        for s, point in zip(when, in_camera, strict=True)
    ]
    return Correspondences(pixels, np.array(points), np.zeros((100, 3)))


@given(st.lists(st.floats(-0.03, 0.03), min_size=6, max_size=6))
def test_points_are_where_the_camera_of_the_middle_row_sees_them(readout: list[float]) -> None:
    found = seen_while_moving(np.array(readout))
    errors = reprojection_errors(CAMERA, POSE, at_middle_row(moving(readout), POSE, found))
    assert errors.max() < 0.01


def test_a_pose_that_is_a_little_off_changes_little() -> None:
    readout = np.array([0.01, -0.01, 0.02, 0.005, 0.01, -0.005])
    found, off = seen_while_moving(readout), make_pose(so3_exp(np.array([0.01, 0, 0])), np.array([0, 0.02, 0]))
    here, there = (at_middle_row(moving(readout), pose, found).points for pose in (POSE, POSE @ off))
    assert np.abs(here - there).max() < 1e-3


def test_who_does_not_move_sees_all_where_it_is() -> None:
    found = seen_while_moving(np.zeros(6))
    np.testing.assert_allclose(at_middle_row(moving(np.zeros(6)), POSE, found).points, found.points, atol=1e-12)
    assert at_middle_row(CAMERA, POSE, found) is found


def test_the_motion_stays_with_the_camera_of_the_photo() -> None:
    camera = replace(moving(np.arange(6.0)), distortion=np.array([0.1, 0, 0, 0]))
    photo = Photo.undistorted(np.zeros((480, 640, 3), np.uint8), camera, 320)
    np.testing.assert_array_equal(photo.limited(160).camera.readout, np.arange(6.0))
