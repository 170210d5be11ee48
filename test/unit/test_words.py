"""Words for people: of exceptions, and of what came from outside."""

from __future__ import annotations

import pytest

from gsfeatloc_ros.common.words import in_one_line, shortened


@pytest.mark.parametrize("text", ["", "x", 1000 * "x"])
def test_what_is_not_too_long_stays_as_it_is(text):
    assert shortened(text) == text


def test_what_is_too_long_keeps_its_beginning_and_its_end():
    text = "prior is in frame '" + 1_000_000 * "x" + "': name the frame"
    short = shortened(text)
    assert len(short) < 1100
    assert short.startswith("prior is in frame 'xxx")
    assert short.endswith("xxx': name the frame")
    assert f"({len(text)} characters)" in short


@pytest.mark.parametrize("text", ["", "a", "a\nb", "a\r\n\n b\x85c\u2028d", 3000 * "a\n"])
def test_an_exception_is_one_line(text):
    assert len(in_one_line(ValueError(text)).splitlines()) <= 1
    assert len(in_one_line(ZeroDivisionError(text)).splitlines()) == 1


@pytest.mark.parametrize("kind", [ValueError, OSError, RuntimeError, ImportError])
def test_what_says_what_is_wrong_is_left_to_speak(kind):
    assert in_one_line(kind("set HOME,\n  or ROS_LOG_DIR")) == "set HOME, or ROS_LOG_DIR"


def test_what_nobody_foresaw_is_named_with_its_place():
    with pytest.raises(OverflowError) as info:
        float(10**400)
    assert "OverflowError: int too large to convert to float (test_words.py, line " in in_one_line(info.value)
    assert in_one_line(KeyError("scale")) == "KeyError: 'scale'"
    assert in_one_line(ValueError()).startswith("ValueError:")


def test_no_memory_is_said_so():
    assert in_one_line(MemoryError()).startswith("out of memory")
    assert "3 TiB" in in_one_line(MemoryError("Unable to allocate 3 TiB"))
