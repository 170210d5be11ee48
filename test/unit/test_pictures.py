"""Pictures of streams: how many bits their samples have, and which of 16UC1 is one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ros_messages import image

from gsfeatloc_ros.ros_io.pictures import PictureReader
from gsfeatloc_ros.ros_io.raw_image import SAMPLE_BITS


def deep_image(largest: int, encoding: str = "mono16", frame: str = "camera", bigendian: int = 0):
    """An image that is black, but for one pixel."""
    samples = np.zeros((6, 8), ">u2" if bigendian else "<u2")
    samples[2, 3] = largest
    message = image(1.0, frame)
    message.encoding, message.step, message.is_bigendian, message.data = encoding, 16, bigendian, samples.tobytes()
    return message


@given(bits=st.sampled_from(SAMPLE_BITS), bigendian=st.integers(0, 1), share=st.floats(0.6, 1.0))
def test_the_largest_number_of_as_many_bits_as_are_needed_is_white(bits, bigendian, share):
    white = 2**bits - 1
    rgb = PictureReader(say=lambda note: None).decode(deep_image(round(share * white), bigendian=bigendian))
    assert rgb[2, 3].tolist() == [round(255 * round(share * white) / white)] * 3
    assert not rgb[0].any()


def test_a_stream_keeps_the_bits_that_it_once_needed_and_they_are_said_once():
    said: list[str] = []
    reader = PictureReader(say=said.append)
    values = [reader.decode(deep_image(value))[2, 3, 0] for value in (1000, 500, 4095, 1000)]
    assert values == [249, 125, 255, 62]
    assert [("'camera'" in note, note.split(" of ")[2].split(":")[0]) for note in said] == [
        (True, "10 bits"),
        (True, "12 bits"),
    ]
    # Another stream is another sensor; one of all bits is nothing to tell of.
    assert reader.decode(deep_image(500, frame="other"))[2, 3, 0] == 125
    reader.decode(deep_image(65535, frame="third"))
    assert len(said) == 3


def test_bits_that_are_given_hold_for_all_and_more_are_refused():
    reader = PictureReader(bits=12)
    assert reader.decode(deep_image(500))[2, 3, 0] == 31
    with pytest.raises(ValueError, match=r"values of 14 bits, more than image\.bits:=12 says"):
        reader.decode(deep_image(4096))


def test_depth_is_no_picture_unless_somebody_says_so():
    with pytest.raises(ValueError, match=r"'16UC1' is that of depth images: .* infrared camera set image.bits"):
        PictureReader().decode(deep_image(4095, "16UC1"))
    assert PictureReader(bits=12).decode(deep_image(4095, "16UC1"))[2, 3, 0] == 255


def test_images_of_8_bits_are_as_they_are():
    message = image(1.0)
    message.data = bytes(range(48))
    for reader in (PictureReader(), PictureReader(bits=12)):
        assert reader.decode(message)[..., 0].ravel().tolist() == list(range(48))
