"""These tests need no ROS; those of messages need its messages, nothing more."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

collect_ignore = [] if find_spec("sensor_msgs") else ["test_messages.py"]

STRANGER = 12345


def _of_a_stranger(path: Path) -> str:
    if os.geteuid() != 0:
        pytest.skip("only root can give files away")
    os.chown(path, STRANGER, STRANGER)
    return f"belongs to user {STRANGER}"


def _writable_by_all(path: Path) -> str:
    path.chmod(0o666)
    return "can be written by others (mode 666)"


def _writable_by_the_group(path: Path) -> str:
    path.chmod(0o664)
    return "can be written by others (mode 664)"


def _a_link(path: Path) -> str:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")
    return "is a link"


def _a_link_to_nothing(path: Path) -> str:
    path.unlink()
    path.symlink_to("nowhere")
    return "is a link"


def _a_pipe(path: Path) -> str:
    """Nobody writes to it: who opens it, waits for ever."""
    path.unlink()
    os.mkfifo(path)
    return "is not a regular file"


@pytest.fixture(
    params=[_of_a_stranger, _writable_by_all, _writable_by_the_group, _a_link, _a_link_to_nothing, _a_pipe],
    ids=lambda change: change.__name__.strip("_"),
)
def untrusted(request) -> Callable[[Path], str]:
    """Makes a file one that others can have written, or none at all; returns what is said of it."""
    return request.param
