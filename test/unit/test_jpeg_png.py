"""Compressed pictures: what is said of them is what the decoder finds, and nothing in them costs more than that."""

from __future__ import annotations

import contextlib
import time
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from picture_files import jpeg_with_hidden_size, png, png_chunk

from gsfeatloc_ros.common import jpeg_png
from gsfeatloc_ros.common.jpeg_png import MAX_PIXELS, decode, read_header

RGB = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)


def encoded(suffix: str, *parameters: int) -> bytes:
    return cv2.imencode(suffix, RGB[:, :, ::-1], parameters)[1].tobytes()


JPEG, PROGRESSIVE = encoded(".jpg"), encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
RESTARTS = encoded(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2)
PNG = encoded(".png")
COMMENT = b"\xff\xfe\x00\x06cats"


@pytest.fixture
def no_decoder(monkeypatch):
    """Nothing is decoded in this test."""

    def refuse(*arguments):
        raise AssertionError("the decoder was called")

    monkeypatch.setattr(jpeg_png.cv2, "imdecode", refuse)


@pytest.mark.parametrize(
    "data",
    [JPEG, PROGRESSIVE, RESTARTS, JPEG[:2] + COMMENT + b"\xff\xff" + JPEG[2:], PNG],
    ids=["baseline", "progressive", "restarts", "comment", "png"],
)
def test_pictures_are_those_of_the_decoder(data):
    picture = read_header(data)
    assert (picture.width, picture.height) == (64, 48)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    np.testing.assert_array_equal(decode(picture), expected)


@pytest.mark.parametrize("mode", [cv2.IMREAD_GRAYSCALE, cv2.IMREAD_UNCHANGED])
def test_grey_and_transparent_pngs(mode):
    pixels = RGB[:, :, 0] if mode == cv2.IMREAD_GRAYSCALE else np.dstack([RGB, RGB[:, :, :1]])
    data = cv2.imencode(".png", pixels)[1].tobytes()
    assert decode(read_header(data)).shape == RGB.shape


@pytest.mark.usefixtures("no_decoder")
@pytest.mark.parametrize("side", [MAX_PIXELS, 30_000, 65_535])
def test_a_size_that_is_hidden_in_bytes_that_libjpeg_skips_is_refused(side):
    data = jpeg_with_hidden_size(JPEG, 64, 48, min(side, 65_535))
    assert len(data) < len(JPEG) + 30
    with pytest.raises(ValueError, match="damaged JPEG"):
        read_header(data)


def test_the_decoder_would_take_the_hidden_size():
    data = jpeg_with_hidden_size(JPEG, 64, 48, 96)
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == (96, 96, 3)


@pytest.mark.usefixtures("no_decoder")
@pytest.mark.parametrize(("width", "height"), [(30_000, 30_000), (65_500, 800), (0, 10)])
def test_more_than_a_camera_has_is_refused_by_its_header(width, height):
    """Of a JPEG and of a PNG that hold it in few bytes."""
    frame = JPEG.index(b"\xff\xc0")
    size = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    for data in (JPEG[: frame + 5] + size + JPEG[frame + 9 :], png(width, height, b"")):
        with pytest.raises(ValueError, match=f"{width}x{height}, more than 50 megapixels|has no pixels"):
            read_header(data)


@pytest.mark.usefixtures("no_decoder")
def test_a_jpeg_of_very_many_scans_is_refused():
    """12 bytes of a scan, which says that nothing changes, take as long as the whole picture."""
    scan = PROGRESSIVE[PROGRESSIVE.rindex(b"\xff\xda") : -2]
    with pytest.raises(ValueError, match="100010 scans"):
        read_header(PROGRESSIVE[:-2] + 100_000 * scan + PROGRESSIVE[-2:])


@pytest.mark.parametrize("kind", [b"zTXt", b"iTXt", b"acTL"])
def test_what_is_no_pixel_of_a_png_is_not_given_to_the_decoder(kind):
    """Comments of 100 kB that unpack to hundreds of MB would take half a minute."""
    bomb = png_chunk(kind, b"a\0\0" + zlib.compress(bytes(7_000_000), 9))
    start = time.process_time()
    pixels = decode(read_header(PNG[:33] + 100 * bomb + PNG[33:]))
    assert time.process_time() - start < 0.5
    np.testing.assert_array_equal(pixels, RGB)


@pytest.mark.usefixtures("no_decoder")
def test_a_jpeg_of_12_bits_is_named():
    precision = JPEG.index(b"\xff\xc0") + 4
    with pytest.raises(ValueError, match="JPEG of 12 bits"):
        read_header(JPEG[:precision] + b"\x0c" + JPEG[precision + 1 :])


@pytest.mark.usefixtures("no_decoder")
def test_a_png_whose_chunk_is_longer_than_the_file_is_refused():
    """The decoder would take 4 GB for it; found by the fuzz campaign."""
    with pytest.raises(ValueError, match="cut short"):
        read_header(PNG[:33] + b"\xff\x7f\x02\x57" + PNG[37:])


@pytest.mark.usefixtures("no_decoder")
def test_a_png_that_holds_more_than_its_pixels_is_refused():
    """All of it would be unpacked: gigabytes."""
    with pytest.raises(ValueError, match="64x48 pixels that holds more"):
        read_header(png(64, 48, bytes(100_000)))


@given(st.data())
def test_a_changed_picture_is_refused_or_of_the_size_that_was_said(data):
    """Whatever is changed in it, so that no decoder can be fooled to another size."""
    content = bytearray(data.draw(st.sampled_from([JPEG, PROGRESSIVE, RESTARTS, PNG])))
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, 400))
        assume(place < len(content))
        change = data.draw(st.binary(max_size=4))
        content[place : place + data.draw(st.integers(0, 4))] = change
    try:
        picture = read_header(bytes(content))
    except ValueError:
        return
    assume(picture.width * picture.height < 10**6)
    with contextlib.suppress(ValueError):
        assert decode(picture).shape == (picture.height, picture.width, 3)
    seen = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    assert seen is None or seen.shape[:2] == (picture.height, picture.width)
