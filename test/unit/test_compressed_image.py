"""Compressed images: what their format declares and what their bytes are is used, or refused by its name."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.ros_io.compressed_image import PictureError
from gsfeatloc_ros.ros_io.pictures import PictureReader
from gsfeatloc_ros.simulate.bag_messages import header, make

SMALL = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)


def message(data: bytes, declared: str, frame: str = "camera"):
    return make("sensor_msgs/msg/CompressedImage", header(0.0, frame), declared, np.frombuffer(data, np.uint8))


def encoded(suffix: str, pixels: np.ndarray = SMALL) -> bytes:
    """A file of pixels in OpenCV's order, blue first."""
    return cv2.imencode(suffix, pixels)[1].tobytes()


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff", encoded(".png")[:40], b"cats"])
def test_damaged_pictures_are_refused_with_their_format(data):
    with pytest.raises(PictureError, match=r"image of format 'jpeg', \d+ bytes, is .*(JPEG|PNG|damaged)"):
        PictureReader().decode(message(data, "jpeg"))


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (encoded(".webp"), "WebP"),
        (encoded(".tiff"), "TIFF"),
        (encoded(".bmp"), "BMP"),
        (encoded(".jp2", np.zeros((64, 64, 3), np.uint8)), "JPEG 2000"),
        (b"\0\0\0\1\x67\x42" + bytes(20), "video .H.264, H.265.*republish decode the video"),
        (b"\0\0\0\x20ftypisom" + bytes(20), "video .MP4.*republish decode the video"),
        (bytes(12) + encoded(".png"), "a depth image .compressedDepth"),
    ],
)
def test_pictures_of_other_kinds_are_named_by_their_bytes(data, kind):
    with pytest.raises(PictureError, match=f"is {kind}"):
        PictureReader().decode(message(data, "jpeg"))


@pytest.mark.parametrize("declared", ["h264", "H265", "hevc", "av1", "bgr8; ffmpeg libx264", "vp9"])
def test_video_is_named_by_its_format(declared):
    with pytest.raises(PictureError, match=f"{declared}.*republish decode the video"):
        PictureReader().decode(message(b"cats and dogs", declared))


@pytest.mark.parametrize(
    ("declared", "says"),
    [
        ("16UC1; compressedDepth png", "a depth image"),
        ("32FC1; compressedDepth rvl", "a depth image"),
        ("32FC1; png compressed ", "a depth image"),
        ("16UC1; png compressed ", "that of depth images: .* set image.bits"),
        ("16SC1; png compressed ", "no picture"),
        ("8UC2; png compressed ", "no picture"),
        ("bayer_rggb8; png compressed ", "no colours yet"),
        ("yuv422; png compressed ", "no colours yet"),
        ("nv12; jpeg compressed ", "no colours yet"),
    ],
)
def test_what_is_declared_to_be_no_picture_in_colour_is_refused(declared, says):
    with pytest.raises(ValueError, match=says):
        PictureReader().decode(message(encoded(".png"), declared))


@pytest.mark.parametrize(
    "declared",
    [
        "",
        "png",
        "jpeg",
        "image/png",
        "rgb8; jpeg compressed bgr8",
        "bgr8; png compressed bgr8",
        "mono8; png compressed ",
    ]
    + [f"{raw}; jpeg compressed bgr8" for raw in ("bayer_rggb8", "yuv422", "nv12", "rgba8")],
)
def test_the_bytes_tell_which_of_the_two_it_is(declared):
    np.testing.assert_array_equal(PictureReader().decode(message(encoded(".png"), declared)), SMALL[:, :, ::-1])


def test_colours_that_were_compressed_red_first_are_declared_so():
    read = PictureReader().decode(message(encoded(".png"), "rgb8; png compressed rgb8"))
    np.testing.assert_array_equal(read, SMALL)


@given(st.integers(0, 255), st.integers(0, 255), st.integers(0, 255), st.sampled_from([".png", ".jpg"]))
def test_compressed_images_keep_their_colour(red, green, blue, suffix):
    rgb = np.full((16, 24, 3), [red, green, blue], np.uint8)
    decoded = PictureReader().decode(message(encoded(suffix, rgb[:, :, ::-1]), suffix[1:]))
    assert decoded.shape == rgb.shape
    assert np.abs(decoded.astype(int) - rgb).max() <= (0 if suffix == ".png" else 4)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize(("bits", "white"), [(10, 1023), (12, 4095), (14, 16383), (16, 65535)])
def test_pngs_of_16_bits_are_scaled_by_the_bits_that_they_need(channels, bits, white):
    samples = np.random.default_rng(bits).integers(0, white + 1, (6, 8, channels)).astype(np.uint16)
    samples[2, 3] = white
    said: list[str] = []
    read = PictureReader(say=said.append).decode(message(encoded(".png", samples), "mono16; png compressed "))
    expected = np.round(255 * samples[:, :, 2::-1].astype(float) / white) * np.ones(3)
    assert read.dtype == np.uint8
    np.testing.assert_allclose(read, expected, atol=1)
    assert ["mono16" in note and f"{bits} bits" in note for note in said] == ([True] if bits < 16 else [])


def test_a_stream_of_16_bits_keeps_its_bits_and_those_that_are_given_hold():
    def dark(largest: int, declared: str = "png", frame: str = "camera"):
        samples = np.zeros((6, 8), np.uint16)
        samples[2, 3] = largest
        return message(encoded(".png", samples), declared, frame)

    reader = PictureReader(say=lambda note: None)
    assert [reader.decode(dark(value))[2, 3, 0] for value in (4095, 1000)] == [255, 62]
    assert reader.decode(dark(1000, frame="other"))[2, 3, 0] == 249
    infrared = PictureReader(bits=12)
    assert infrared.decode(dark(4095, "16UC1; png compressed "))[2, 3, 0] == 255
    with pytest.raises(ValueError, match=r"14 bits, more than image\.bits:=12"):
        infrared.decode(dark(4096))


def test_a_header_is_read_once():
    opened = PictureReader().open(message(encoded(".png"), "png"))
    assert (opened.width, opened.height) == (8, 6)
    np.testing.assert_array_equal(opened.decode(), SMALL[:, :, ::-1])
