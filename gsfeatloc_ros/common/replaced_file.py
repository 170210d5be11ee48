"""Files that are written in one step."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def replaced_file(path: Path) -> Iterator[BinaryIO]:
    """Open what is to take the place of a file, or to be it.

    Whoever reads `path` finds the old file or the whole new one, after a power cut as well. It is put in place at the
    end of the block, and not at all if that is left by an exception.

    Args:
        path: of the file; its folder must be there.

    Raises:
        OSError: it cannot be written.
    """
    # Beside it: a file is only renamed within a file system.
    temporary = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
