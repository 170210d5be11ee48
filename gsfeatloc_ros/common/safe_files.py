"""Files that others may have put there: opened without waiting, trusted only if no other can write them."""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path

_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class UntrustedError(OSError):
    """A file may have been written by another user; the message says why, and what to do."""


def open_regular(path: Path) -> BufferedReader:
    """Open a file for reading; other than `open` this does not wait for the writer of a pipe.

    Raises:
        OSError: it cannot be read, or is a folder, a pipe, a device.
    """
    return _open(path, 0)


def read_regular(path: Path, limit: int) -> bytes:
    """Read a whole file, of at most so many bytes.

    Raises:
        ValueError: it is larger.
        OSError: it cannot be read, or is a folder, a pipe, a device.
    """
    with open_regular(path) as stream:
        data = stream.read(limit + 1)
    if len(data) > limit:
        raise ValueError(f"is of more than {limit // 10**6} megabytes")
    return data


def open_own(path: Path) -> BufferedReader:
    """Open a file that was written here before: a cache, say, whose content nobody checks against what it is of.

    Raises:
        UntrustedError: it is a link, belongs to neither this user nor root, or can be written by others.
        OSError: it cannot be read, or is a folder, a pipe, a device.
    """
    if path.is_symlink():
        raise UntrustedError("is a link, which is not followed: delete it")
    stream = _open(path, os.O_NOFOLLOW)
    try:
        check_own(os.fstat(stream.fileno()))
    except UntrustedError:
        stream.close()
        raise
    return stream


def check_own(status: os.stat_result) -> None:
    """Raise UntrustedError unless a file or folder belongs to this user or root, and no other can write to it."""
    if status.st_uid not in (0, os.geteuid()):
        raise UntrustedError(f"belongs to user {status.st_uid}, not to this one ({os.geteuid()}) or root: delete it")
    if status.st_mode & _OTHERS_WRITE:
        raise UntrustedError(f"can be written by others (mode {stat.S_IMODE(status.st_mode):o}): delete it")


def _open(path: Path, flags: int) -> BufferedReader:
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | flags)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError("is not a regular file")
    # Other than os.fdopen, so the stream knows its file's name.
    return open(path, "rb", opener=lambda path, flags: descriptor)
