"""Files that are written in one step."""

from __future__ import annotations

import contextlib
import fcntl
import glob
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from gsfeatloc_ros.common.safe_files import open_own

_SUFFIX = ".tmp"


@contextmanager
def replaced_file(path: Path) -> Iterator[BinaryIO]:
    """Open, to be written and read, what is to take the place of a file, or to be it.

    Whoever reads `path` finds the old file or the whole new one, after a power cut as well. It is put in place at the
    end of the block, and not at all if that is left by an exception. Others can read it, not write to it.

    Args:
        path: of the file; its folder must be there.

    Raises:
        OSError: it cannot be written, or is a folder or a device.
    """
    # Root could: others need it.
    if path.is_char_device() or path.is_block_device():
        raise OSError(f"{path} is a device")
    _remove_leftovers(path)
    # Beside it: a file is only renamed within a file system. Nobody can have put a link there under a name of chance.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}{_SUFFIX}")
    try:
        descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    except OSError as error:
        # Of the name of chance nobody knows.
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        with os.fdopen(descriptor, "w+b") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
            os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def _remove_leftovers(path: Path) -> None:
    """Remove what processes left that were killed while they wrote `path`: those that write hold a lock."""
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.*{_SUFFIX}"):
        with contextlib.suppress(OSError), open_own(leftover) as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            leftover.unlink()
