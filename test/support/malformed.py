"""Messages that no sensor should send, drawn by hypothesis, each with the reason that is expected for it."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from node_harness import Client
from picture_files import jpeg_with_hidden_size, png
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from gsfeatloc_ros.client.messages import camera_info_of, stamp_of
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.ros_io.raw_image import ENCODINGS, MAX_SIDE

# How long a message takes to arrive, in seconds. If it took longer, it is sent again.
ARRIVAL = 0.02
RETRIES = 5


def examples(count: int) -> Callable:
    """So many of what is drawn, always the same."""
    return settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        # To look for a simpler example takes minutes with a node that answers.
        phases=[Phase.generate],
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
    )


def assert_refused(client: Client, topic: str, message: Any, says: str) -> None:
    """The newest message of a topic cannot be used: a request to relocalize gets no pose, for a reason that matches."""
    answers = []
    for _ in range(RETRIES):
        client.publisher(topic, type(message)).publish(message)
        client.spin(ARRIVAL)
        answer = client.relocalize()
        if not answer.success and re.search(says, answer.message, re.DOTALL):
            break
        answers.append(answer.message)
    else:
        raise AssertionError(f"no refusal that says {says!r} but {set(answers)} to {message}")
    assert stamp_of(message) not in client.poses


not_finite = st.sampled_from([math.nan, math.inf, -math.inf])
infinite = st.sampled_from([math.inf, -math.inf])
# All that a string may hold in DDS.
words = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)
uint32 = st.integers(0, 2**32 - 1)
stamps = st.builds(Time, sec=st.integers(-(2**31), 2**31 - 1), nanosec=uint32)


@st.composite
def images(draw) -> tuple[Image, str]:
    """Images that cannot be decoded, and the reason."""
    encoding = draw(st.sampled_from(sorted(ENCODINGS)))
    image = Image(width=64, height=48, encoding=encoding, step=64 * 8, data=bytes(64 * 8 * 48))
    image.header.stamp, image.header.frame_id = draw(stamps), draw(words)
    row_bytes = 64 * ENCODINGS[encoding].channels * ENCODINGS[encoding].bits // 8

    def of_unknown_encoding() -> str:
        image.encoding = draw(words.filter(lambda word: word not in ENCODINGS))
        return f"image encoding {image.encoding!r} is not supported"

    def of_a_size_that_no_camera_has() -> str:
        side = draw(st.one_of(st.just(0), st.integers(MAX_SIDE + 1, 2**32 - 1)))
        setattr(image, draw(st.sampled_from(["width", "height"])), side)
        return f"image size {image.width}x{image.height} must be"

    def of_short_rows() -> str:
        image.step = draw(st.integers(0, row_bytes - 1))
        return f"image step {image.step} is less than the {row_bytes} bytes of a row"

    def of_rows_that_are_not_there() -> str:
        image.step = draw(st.integers(64 * 8 + 1, 2**32 - 1))
        return f"image data has {len(image.data)} bytes but step {image.step}"

    def cut_short() -> str:
        count = draw(st.integers(0, len(image.data) - 1))
        image.data = image.data[:count]
        return f"image data has {count} bytes but"

    def of_another_camera() -> str:
        return "camera_info is for 640x480 but the image is 64x48"

    kinds = [
        of_unknown_encoding,
        of_a_size_that_no_camera_has,
        of_short_rows,
        of_rows_that_are_not_there,
        cut_short,
        of_another_camera,
    ]
    says = re.escape(draw(st.sampled_from(kinds))())
    return image, says


@st.composite
def camera_infos(draw, camera: Camera) -> tuple[CameraInfo, str]:
    """Calibrations that no camera of these images has, and the reason."""
    info = camera_info_of(camera)
    info.header.stamp, info.header.frame_id = draw(stamps), draw(words)

    def not_finite_k() -> str:
        info.k[draw(st.integers(0, 8))] = draw(not_finite)
        return "camera K and distortion must be finite"

    def not_finite_d() -> str:
        info.d[draw(st.integers(0, 4))] = draw(not_finite)
        return "camera K and distortion must be finite"

    def not_calibrated() -> str:
        info.k = [0.0] * 9
        return "it has a K of zeros"

    def of_no_focal_length() -> str:
        info.k[draw(st.sampled_from([0, 4]))] = draw(st.floats(-1e300, 0.0))
        return "focal lengths .* must be positive"

    def of_a_turned_k() -> str:
        info.k[draw(st.sampled_from([3, 6, 7]))] = draw(st.floats(1e-3, 1e300))
        return "camera K must be upper triangular"

    def of_no_size() -> str:
        setattr(info, draw(st.sampled_from(["width", "height"])), 0)
        return r"its size is .* have the driver fill in the size"

    def of_another_size() -> str:
        info.width, info.height = draw(st.integers(641, 2**32 - 1)), draw(st.integers(1, 2**32 - 1))
        return f"camera_info is for {info.width}x{info.height} but the image is 640x480"

    def of_unknown_model() -> str:
        info.distortion_model = "of " + draw(words)
        return re.escape(f"distortion model {info.distortion_model!r} is not one of")

    def of_too_many_coefficients() -> str:
        info.d = [0.1] * draw(st.integers(15, 1000))
        return f"distortion model plumb_bob takes .* coefficients, got {len(info.d)}"

    def of_a_region_outside() -> str:
        info.roi.x_offset, info.roi.width = draw(st.integers(600, 2**32 - 1)), draw(st.integers(41, 2**32 - 1))
        return "region of interest of .* outside its 640x480"

    def of_one_bin() -> str:
        setattr(info, draw(st.sampled_from(["binning_x", "binning_y"])), draw(st.integers(641, 2**32 - 1)))
        return "camera size .* must be positive"

    kinds = [
        not_finite_k,
        not_finite_d,
        not_calibrated,
        of_no_focal_length,
        of_a_turned_k,
        of_no_size,
        of_another_size,
        of_unknown_model,
        of_too_many_coefficients,
        of_a_region_outside,
        of_one_bin,
    ]
    return info, draw(st.sampled_from(kinds))()


@st.composite
def poses(draw, good: PoseStamped, message_type: type, name: str) -> tuple[Any, str]:
    """Rough poses that cannot be used, and the reason."""
    message = message_type(header=Header(stamp=draw(stamps), frame_id="map"))
    pose = message.pose if message_type is PoseStamped else message.pose.pose
    for part in ("position", "orientation"):
        for axis in getattr(good.pose, part).get_fields_and_field_types():
            setattr(getattr(pose, part), axis, getattr(getattr(good.pose, part), axis))

    def of_no_position() -> str:
        setattr(pose.position, draw(st.sampled_from("xyz")), draw(not_finite))
        return f"{name} has position .* must be finite"

    def of_no_orientation() -> str:
        setattr(pose.orientation, draw(st.sampled_from("xyzw")), draw(not_finite))
        return f"{name} has position .* must be finite"

    def of_a_quaternion_of_zeros() -> str:
        for axis in "xyzw":
            setattr(pose.orientation, axis, draw(st.sampled_from([0.0, -0.0, 1e-300])))
        return f"{name} cannot be used: quaternion .* has no direction"

    def in_no_frame() -> str:
        message.header.frame_id = ""
        return f"{name} is in frame '': name the frame"

    def in_an_unknown_frame() -> str:
        message.header.stamp = Time()
        message.header.frame_id = draw(words.filter(lambda word: word not in ("", "map")))
        return re.escape(f"{name} is in frame {message.header.frame_id!r} but the map is in 'map'")

    def of_no_covariance() -> str:
        message.pose.covariance[draw(st.integers(0, 35))] = draw(infinite)
        return f"{name} has covariance .* must be finite"

    def of_a_negative_variance() -> str:
        message.pose.covariance[7 * draw(st.integers(0, 5))] = draw(
            st.floats(-1e300, -1e-300).filter(lambda variance: variance != -1)
        )
        return f"{name} has covariance .* no variance negative"

    def of_another_time() -> str:
        message.header.stamp = Time(sec=draw(st.integers(10_000_000, 2**31 - 1)), nanosec=draw(uint32))
        return f"{name} is .* s newer than the image .*prior_max_age"

    kinds = [
        of_no_position,
        of_no_orientation,
        of_a_quaternion_of_zeros,
        in_no_frame,
        in_an_unknown_frame,
        of_another_time,
    ]
    if message_type is not PoseStamped:
        kinds += [of_no_covariance, of_a_negative_variance]
    return message, draw(st.sampled_from(kinds))()


@st.composite
def compressed_images(draw, rgb: np.ndarray) -> tuple[CompressedImage, str]:
    """Compressed images that hold no picture of this camera, and the reason."""
    extension = draw(st.sampled_from(["jpeg", "png"]))
    encoded = cv2.imencode(f".{extension}", rgb)[1].tobytes()
    image = CompressedImage(format=extension, data=encoded)
    image.header.stamp, image.header.frame_id = draw(stamps), draw(words)

    def garbage() -> str:
        image.data, image.format = draw(st.binary(max_size=1000)), draw(words.filter(lambda w: "bayer" not in w))
        return "is (a )?damaged|is no JPEG or PNG|has no pixels|cannot be decoded"

    def header_only() -> str:
        image.data = encoded[: draw(st.integers(0, 20))]
        return "is (a )?damaged|is no JPEG or PNG|has no pixels|cannot be decoded"

    def of_another_size() -> str:
        width, height = draw(st.integers(1, 64)), draw(st.integers(1, 48))
        image.data = cv2.imencode(f".{extension}", rgb[:height, :width])[1].tobytes()
        return f"camera_info is for 640x480 but the image is {width}x{height}"

    def depth() -> str:
        image.format = draw(words) + "compressedDepth" + draw(words)
        return "is a depth image"

    def bayer() -> str:
        image.format = "bayer_rggb8; jpeg compressed"
        return "has no colours yet"

    def of_a_hidden_size() -> str:
        jpeg = cv2.imencode(".jpeg", rgb)[1].tobytes()
        image.data, image.format = jpeg_with_hidden_size(jpeg, 640, 480, draw(st.integers(20_000, 65_535))), "jpeg"
        return "is a damaged JPEG"

    def huge() -> str:
        side = draw(st.integers(MAX_SIDE + 1, 2**31 - 1))
        image.data = png(side, side, zlib.compress(bytes(1000)))
        return "megapixels"

    return image, draw(st.sampled_from([garbage, header_only, of_another_size, depth, bayer, of_a_hidden_size, huge]))()
