"""Calibrations as drivers send them, against OpenCV's own functions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ros_messages import camera_info

from gsfeatloc_ros.ros_io.calibration import decode_camera

K = np.array([[500.0, 0, 322], [0, 502, 236], [0, 0, 1]])
PIXELS = np.array([[20.0, 30.0], [322.0, 236.0], [600.0, 100.0], [330.0, 400.0]])
coefficients = st.floats(-0.01, 0.01).filter(lambda value: abs(value) > 1e-4)


def info(model: str, d: list[float], **changes: object):
    message = camera_info(640, 480)
    message.k, message.distortion_model, message.d = K.ravel().tolist(), model, d
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def by_opencv(d: list[float]) -> np.ndarray:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    return cv2.undistortImagePoints(PIXELS.reshape(-1, 1, 2), K, np.array(d), None, criteria).reshape(-1, 2)


@given(
    model=st.sampled_from(
        ["", "plumb_bob", "radtan", "radial_tangential", "brown_conrady", "rational_polynomial", "Plumb_Bob"]
    ),
    d=st.lists(coefficients, max_size=14),
    zeros=st.integers(0, 20),
)
def test_polynomials_are_opencvs_of_as_many_coefficients_as_are_not_zero(model, d, zeros):
    camera = decode_camera(info(model, d + zeros * [0.0]))
    count = next(count for count in (0, 4, 5, 8, 12, 14) if count >= len(d))
    assert len(camera.distortion) == count
    expected = by_opencv(d + (count - len(d)) * [0.0]) if d else PIXELS
    np.testing.assert_allclose(camera.undistort(PIXELS), expected, atol=1e-6)


@given(model=st.sampled_from(["equidistant", "fisheye", "kannala_brandt"]), d=st.lists(coefficients, max_size=4))
def test_fisheyes_are_opencvs(model, d):
    camera = decode_camera(info(model, [*d, 0.0, 0.0]))
    four = np.pad(d, (0, 4 - len(d)))
    expected = cv2.fisheye.undistortPoints(PIXELS.reshape(-1, 1, 2), K, four, P=K).reshape(-1, 2)
    assert camera.model == "equidistant"
    np.testing.assert_allclose(camera.undistort(PIXELS), expected, atol=1e-9)


@pytest.mark.parametrize("model", ["none", "pinhole", "inverse_brown_conrady", "plumb_bob", ""])
@pytest.mark.parametrize("d", [[], [0.0], [0.0] * 5, [0.0] * 20])
def test_zeros_are_no_distortion(model, d):
    assert not decode_camera(info(model, d)).distorted


@pytest.mark.parametrize(
    ("model", "d", "says"),
    [
        ("none", [0.1], "model none takes at most 0 coefficients, got 1"),
        ("inverse_brown_conrady", [0.1], "takes at most 0"),
        ("fisheye", [0.1] * 5, "model fisheye takes at most 4"),
        ("plumb_bob", [0.1] * 15, "takes at most 14"),
        ("omni", [0.1], "'omni' is not one of plumb_bob, .*image.rectified:=true"),
        ("thin_prism_fisheye", [0.0], "'thin_prism_fisheye' is not one of"),
    ],
)
def test_models_that_cannot_be_used_are_named(model, d, says):
    with pytest.raises(ValueError, match=f"^camera_info cannot be used: .*{says}"):
        decode_camera(info(model, d))


P = [450.0, 0, 320, 0, 0, 450, 240, 0, 0, 0, 1, 0]


@pytest.mark.parametrize(
    ("changes", "rectified", "says"),
    [
        ({"width": 0, "height": 0}, False, "its size is 0x0: have the driver fill in the size"),
        ({"k": [0.0] * 9}, False, "a K of zeros, the camera is not calibrated"),
        ({"k": [0.0] * 9, "p": P}, False, "a K of zeros, but a P: .* rectified, set image.rectified:=true"),
        ({"p": [0.0] * 12}, True, "a P of zeros, but a K: .* raw, set image.rectified:=false"),
        ({"k": [0.0] * 9, "p": [0.0] * 12}, True, "a P of zeros, the camera is not calibrated"),
    ],
)
def test_what_is_not_calibrated_is_told_what_to_do(changes, rectified, says):
    with pytest.raises(ValueError, match=says):
        decode_camera(info("plumb_bob", [], **changes), rectified)


def test_a_region_that_is_still_to_be_rectified_is_refused():
    message = info("plumb_bob", [0.1, 0, 0, 0, 0], p=P)
    message.roi.x_offset, message.roi.width, message.roi.height = 40, 320, 240
    assert decode_camera(message, rectified=True).K[0, 2] == 280
    message.roi.do_rectify = True
    assert decode_camera(message).K[0, 2] == 282
    with pytest.raises(ValueError, match="region of interest of 320x240 at 40, 0 of the raw image"):
        decode_camera(message, rectified=True)
    message.roi.x_offset, message.roi.width, message.roi.height = 0, 640, 480
    assert decode_camera(message, rectified=True).K[0, 2] == 320
