"""Messages in and out, against encoders and colour formulas written here pixel by pixel."""

from __future__ import annotations

import re
import struct

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.node.encode import image_message, pose_message
from gsfeatloc_ros.ros_io.calibration import decode_camera
from gsfeatloc_ros.ros_io.decode import decode_pose
from gsfeatloc_ros.ros_io.raw_image import ENCODINGS, decode_image, validate_image

COLOUR_ORDER = {"rgb8": "rgb", "bgr8": "bgr", "rgba8": "rgba", "bgra8": "bgra", "8UC3": "bgr", "8UC4": "bgra"}
DEEP_COLOUR_ORDER = {
    "rgb16": "rgb",
    "bgr16": "bgr",
    "rgba16": "rgba",
    "bgra16": "bgra",
    "16UC3": "bgr",
    "16UC4": "bgra",
}
PLANAR_ORDER = {"nv12": "uv", "nv21": "vu", "nv24": "uv"}
YUV_ORDER = {"yuv422": "uyvy", "uyvy": "uyvy", "yuv422_yuy2": "yuyv", "yuyv": "yuyv"}
BAYER = sorted(name for name in ENCODINGS if name.startswith("bayer"))
MONO = ("mono8", "mono16", "8UC1", "16UC1")
DEEP = re.compile("16$|^16UC")
any_double = st.floats(allow_nan=True, allow_infinity=True)


def make_image(encoding: str, samples: np.ndarray, padding: int, bigendian: bool) -> Image:
    """Image of samples (H, samples per row), every row followed by `padding` bytes of rubbish."""
    code = (">" if bigendian else "<") + ("H" if DEEP.search(encoding) else "B")
    rows = [b"".join(struct.pack(code, int(value)) for value in row) + b"\xa5" * padding for row in samples]
    message = Image(encoding=encoding, height=len(rows), step=len(rows[0]), is_bigendian=int(bigendian))
    message.data = b"".join(rows)
    return message


@st.composite
def images(draw, encodings):
    """An image of one of `encodings` with its samples: (message, samples (H, samples per row))."""
    encoding = draw(st.sampled_from(sorted(encodings)))
    smallest = ENCODINGS[encoding].smallest
    multiple = ENCODINGS[encoding].multiple
    width = draw(st.integers(smallest[0], 9)) // multiple[0] * multiple[0]
    height = draw(st.integers(smallest[1], 7))
    dtype = np.uint16 if DEEP.search(encoding) else np.uint8
    samples = draw(npst.arrays(dtype, (height, width * ENCODINGS[encoding].channels)))
    message = make_image(encoding, samples, draw(st.integers(0, 5)), draw(st.booleans()))
    message.width = width
    return message, samples


@given(images(COLOUR_ORDER))
def test_colour_is_put_in_the_order_rgb(case):
    message, samples = case
    order = COLOUR_ORDER[message.encoding]
    pixels = samples.reshape(message.height, message.width, len(order))
    rgb = decode_image(message)
    for channel, colour in enumerate("rgb"):
        assert np.array_equal(rgb[..., channel], pixels[..., order.index(colour)])


@given(images(DEEP_COLOUR_ORDER))
def test_colour_of_16_bits_becomes_8(case):
    message, samples = case
    order = DEEP_COLOUR_ORDER[message.encoding]
    pixels = samples.reshape(message.height, message.width, len(order))
    rgb = decode_image(message)
    for channel, colour in enumerate("rgb"):
        expected = [[round(int(v) / 257) for v in row] for row in pixels[..., order.index(colour)]]
        assert np.array_equal(rgb[..., channel], expected)


@given(
    encoding=st.sampled_from(sorted(PLANAR_ORDER)),
    size=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    padding=st.integers(0, 5),
    data=st.data(),
)
def test_chroma_that_lies_below_the_brightness_follows_bt601(encoding, size, padding, data):
    height, width = 2 * size[0], 2 * size[1]
    luma = data.draw(npst.arrays(np.uint8, (height, width), elements=st.integers(16, 255)))
    # One pair of chroma values for each four pixels; nv24 has them for each pixel.
    pairs = data.draw(npst.arrays(np.uint8, (height // 2, width // 2, 2)))
    chroma = pairs if encoding != "nv24" else pairs.repeat(2, 0).repeat(2, 1)
    message = make_image(encoding, np.vstack([luma, chroma.reshape(-1, width)]), padding, bigendian=False)
    message.width, message.height = width, height
    rgb = decode_image(message)
    for row in range(height):
        for column in range(width):
            value = dict(zip(PLANAR_ORDER[encoding], pairs[row // 2, column // 2].astype(float) - 128, strict=True))
            y, u, v = 1.164 * (float(luma[row, column]) - 16), value["u"], value["v"]
            expected = np.clip([y + 1.596 * v, y - 0.813 * v - 0.391 * u, y + 2.018 * u], 0, 255)
            assert np.allclose(rgb[row, column], expected, atol=2)
    message.data = message.data[:-1]
    with pytest.raises(ValueError, match="with the chroma"):
        decode_image(message)


def test_every_encoding_that_is_of_a_picture_is_known():
    # sensor_msgs/image_encodings.hpp of Jazzy, but for flow, signed numbers and the like: 8UC2, 16SC1, 32FC3 ...
    assert set(ENCODINGS) == {*COLOUR_ORDER, *DEEP_COLOUR_ORDER, *MONO, *YUV_ORDER, *PLANAR_ORDER, *BAYER}
    assert len(BAYER) == 8


@given(images(MONO))
def test_grey_fills_all_channels_and_16_bits_become_8(case):
    message, samples = case
    grey = samples if not DEEP.search(message.encoding) else [[round(int(v) / 257) for v in row] for row in samples]
    rgb = decode_image(message)
    for channel in range(3):
        assert np.array_equal(rgb[..., channel], grey)


@given(images(YUV_ORDER))
def test_yuv422_follows_bt601(case):
    message, samples = case
    order = YUV_ORDER[message.encoding]
    rgb = decode_image(message)
    for row in range(message.height):
        for column in range(message.width):
            pair = samples[row, column // 2 * 4 :][:4].astype(float)
            luma = [value for value, name in zip(pair, order, strict=True) if name == "y"][column % 2]
            u, v = pair[order.index("u")] - 128, pair[order.index("v")] - 128
            y = 1.164 * (luma - 16)
            expected = np.clip([y + 1.596 * v, y - 0.813 * v - 0.391 * u, y + 2.018 * u], 0, 255)
            # Below black (luma < 16) OpenCV cuts the luma at 16.
            if luma >= 16:
                assert np.allclose(rgb[row, column], expected, atol=2)


@given(images(BAYER))
def test_bayer_is_interpolated_between_the_nearest_samples_of_each_colour(case):
    message, samples = case
    pattern = message.encoding.removeprefix("bayer_")[:4]
    if message.encoding.endswith("16"):
        samples = np.array([[round(int(v) / 257) for v in row] for row in samples])
    rgb = decode_image(message)
    for row in range(1, message.height - 1):
        for column in range(1, message.width - 1):
            window = [(y, x) for y in (row - 1, row, row + 1) for x in (column - 1, column, column + 1)]
            for channel, colour in enumerate("rgb"):
                sites = [(y, x) for y, x in window if pattern[y % 2 * 2 + x % 2] == colour]
                # A sample of this colour at the pixel itself is taken as it is.
                sites = [(row, column)] if (row, column) in sites else sites
                assert abs(rgb[row, column, channel] - np.mean([samples[site] for site in sites])) <= 1


@given(npst.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))))
def test_image_message_comes_back_as_it_was(rgb):
    message = image_message(rgb, Header(frame_id="camera"))
    assert (message.encoding, message.header.frame_id) == ("rgb8", "camera")
    assert np.array_equal(decode_image(message), rgb)


@given(npst.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9))))
def test_image_message_of_grey_pixels_comes_back_as_it_was(grey):
    message = image_message(grey, Header(frame_id="camera"))
    assert (message.encoding, message.step) == ("mono8", grey.shape[1])
    assert np.array_equal(decode_image(message), np.repeat(grey[..., None], 3, axis=2))


def test_image_message_takes_a_view():
    rgb = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    assert np.array_equal(decode_image(image_message(rgb[::2, ::3], Header())), rgb[::2, ::3])


def test_data_longer_than_the_image_is_taken():
    message = make_image("mono8", np.full((3, 4), 7), padding=0, bigendian=False)
    message.width = 4
    message.data = bytes(message.data) + b"rest"
    assert (decode_image(message) == 7).all()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"encoding": "jpeg"}, "encoding 'jpeg' is not supported"),
        ({"encoding": ""}, "encoding '' is not supported"),
        ({"encoding": "32FC1"}, "encoding '32FC1' is that of depth images"),
        ({"width": 0}, "size 0x4"),
        ({"height": 0}, "size 4x0"),
        ({"width": 2**32 - 1, "height": 2**32 - 1, "step": 2**32 - 1}, "size 4294967295x4294967295"),
        ({"step": 11}, "step 11 is less than the 12 bytes"),
        ({"data": bytes(47)}, "data has 47 bytes"),
        ({"data": b""}, "data has 0 bytes"),
        ({"encoding": "yuyv", "width": 3}, "size 3x[0-9]+ must be a multiple of 2x1"),
        ({"encoding": "bayer_rggb8", "width": 2}, "too small"),
    ],
)
def test_image_that_cannot_be_decoded_is_refused_with_the_reason(changes, says):
    fields = {"encoding": "rgb8", "width": 4, "height": 4, "step": 12, "data": bytes(48)} | changes
    message = Image(**fields)
    with pytest.raises(ValueError, match=says):
        validate_image(message)
    with pytest.raises(ValueError, match=says):
        decode_image(message)


sizes = st.integers(0, 12) | st.integers(0, 2**32 - 1)


@settings(max_examples=300)
@given(
    encoding=st.sampled_from(sorted(ENCODINGS)) | st.text(),
    width=sizes,
    height=sizes,
    step=st.integers(0, 60) | sizes,
    bigendian=st.integers(0, 255),
    data=st.binary(max_size=400),
)
def test_any_image_is_decoded_or_refused_with_value_error(encoding, width, height, step, bigendian, data):
    message = Image(encoding=encoding, width=width, height=height, step=step, is_bigendian=bigendian, data=data)
    try:
        rgb = decode_image(message)
    except ValueError:
        return
    assert rgb.shape == (height, width, 3)
    assert rgb.dtype == np.uint8


def camera_info(**changes) -> CameraInfo:
    fields = {
        "width": 64,
        "height": 48,
        "k": [50.0, 0.0, 31.5, 0.0, 51.0, 23.5, 0.0, 0.0, 1.0],
        "d": [0.1, -0.2, 0.001, 0.002, 0.05],
        "distortion_model": "plumb_bob",
    }
    return CameraInfo(**(fields | changes))


def test_camera_has_the_calibration():
    camera = decode_camera(camera_info())
    assert (camera.width, camera.height, camera.model) == (64, 48, "plumb_bob")
    assert camera.K.tolist() == [[50, 0, 31.5], [0, 51, 23.5], [0, 0, 1]]
    assert camera.distortion.tolist() == [0.1, -0.2, 0.001, 0.002, 0.05]


@pytest.mark.parametrize(
    ("model", "count"), [("rational_polynomial", 8), ("equidistant", 4), ("plumb_bob", 0), ("", 0)]
)
def test_camera_models_of_camera_info(model, count):
    camera = decode_camera(camera_info(distortion_model=model, d=[0.01] * count))
    assert len(camera.distortion) == count
    assert camera.model == (model or "plumb_bob")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"k": [0.0] * 9}, "not calibrated"),
        ({"width": 0}, "size is 0x48: have the driver fill in the size"),
        ({"k": [float("nan")] * 9}, "finite"),
        ({"d": [float("inf")] * 5}, "finite"),
        ({"distortion_model": "thin_prism"}, "'thin_prism' is not one of"),
        ({"d": [0.1] * 15}, "takes at most 14 coefficients, got 15"),
    ],
)
def test_camera_info_that_cannot_be_used_is_refused_with_the_reason(changes, says):
    with pytest.raises(ValueError, match=says):
        decode_camera(camera_info(**changes))


@given(
    k=st.lists(any_double, min_size=9, max_size=9),
    d=st.lists(any_double, max_size=15),
    model=st.sampled_from(["plumb_bob", "rational_polynomial", "equidistant", ""]) | st.text(),
    width=sizes,
)
def test_any_camera_info_is_taken_or_refused_with_value_error(k, d, model, width):
    try:
        camera = decode_camera(camera_info(k=k, d=d, distortion_model=model, width=width))
    except ValueError:
        return
    assert np.isfinite(camera.K).all()


def prior_message(position=(1.0, 2.0, 3.0), quaternion=(0.0, 0.0, 0.0, 1.0), frame="map") -> PoseStamped:
    message = PoseStamped(header=Header(frame_id=frame))
    pose = message.pose
    pose.position.x, pose.position.y, pose.position.z = position
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = quaternion
    return message


def test_prior_of_any_length_of_quaternion_is_normalised():
    # 90 degrees about z: x becomes y.
    pose = decode_pose(prior_message(quaternion=(0.0, 0.0, 3.0, 3.0)), "prior")
    assert np.allclose(pose, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"position": (float("nan"), 0.0, 0.0)}, "finite"),
        ({"quaternion": (0.0, float("inf"), 0.0, 1.0)}, "finite"),
        ({"quaternion": (0.0, 0.0, 0.0, 0.0)}, "no direction"),
    ],
)
def test_prior_that_cannot_be_used_is_refused_with_the_reason(changes, says):
    with pytest.raises(ValueError, match=says):
        decode_pose(prior_message(**changes), "prior")


@given(position=st.tuples(*[any_double] * 3), quaternion=st.tuples(*[any_double] * 4))
def test_any_prior_is_a_pose_or_refused_with_value_error(position, quaternion):
    try:
        pose = decode_pose(prior_message(position, quaternion), "prior")
    except ValueError:
        return
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) > 0
    assert pose[:3, 3].tolist() == list(position)


@given(
    rotation=npst.arrays(np.float64, 3, elements=st.floats(-3, 3)),
    translation=npst.arrays(np.float64, 3, elements=st.floats(-1e6, 1e6)),
)
def test_pose_message_is_the_pose_that_a_prior_would_give(rotation, translation):
    pose = make_pose(so3_exp(rotation), translation)
    covariance = np.arange(36.0).reshape(6, 6)
    message = pose_message(pose, covariance, Header(frame_id="map"))
    assert message.pose.covariance.tolist() == list(range(36))
    prior = PoseStamped(header=message.header, pose=message.pose.pose)
    assert np.allclose(decode_pose(prior, "prior"), pose, atol=1e-9)


def test_the_camera_of_a_region_that_is_binned():
    """A pixel of the image is where the blocks of the whole sensor's pixels put it."""
    info = CameraInfo(width=640, height=480, k=[500.0, 0, 322, 0, 502, 236, 0, 0, 1], d=[0.1, 0, 0, 0, 0])
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 100, 50, 400, 300
    info.binning_x, info.binning_y = 2, 3
    camera = decode_camera(info)
    assert (camera.width, camera.height) == (200, 100)
    assert camera.distortion[0] == 0.1
    points = np.array([[0.1, -0.2, 1.0], [0.0, 0.0, 2.0]])
    whole = points[:, :2] / points[:, 2:] * [500, 502] + [322, 236]
    np.testing.assert_allclose(camera.project(points), (whole - [100, 50] + 0.5) / [2, 3] - 0.5)


def test_rectified_images_have_the_camera_of_p():
    info = CameraInfo(width=640, height=480, k=[500.0, 0, 322, 0, 502, 236, 0, 0, 1], d=[0.1, 0, 0, 0, 0])
    info.p = [450.0, 0, 320, -45, 0, 450, 240, 0, 0, 0, 1, 0]
    camera = decode_camera(info, rectified=True)
    np.testing.assert_array_equal(camera.K, [[450, 0, 320], [0, 450, 240], [0, 0, 1]])
    assert not camera.distorted
    info.p = [0.0] * 12
    with pytest.raises(ValueError, match="a P of zeros"):
        decode_camera(info, rectified=True)


def test_a_region_outside_of_the_sensor_is_refused():
    info = CameraInfo(width=640, height=480, k=[500.0, 0, 322, 0, 502, 236, 0, 0, 1])
    info.roi.x_offset, info.roi.width, info.roi.height = 300, 400, 300
    with pytest.raises(ValueError, match="outside its 640x480"):
        decode_camera(info)
