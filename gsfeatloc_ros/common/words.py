"""Words for people: of exceptions, and of what came from outside and may be of any length."""

from __future__ import annotations

import traceback
from pathlib import Path

# Characters of a text that is to be read. A frame's name of a megabyte in each line would fill the disk of a robot.
_MAX_LENGTH = 1000


def shortened(text: str, limit: int = _MAX_LENGTH) -> str:
    """Return the text, or its beginning and its end if it has more than `limit` characters: what to do stands last."""
    if len(text) <= limit:
        return text
    return f"{text[: limit // 2]} ... ({len(text)} characters) ... {text[len(text) - limit // 2 :]}"


def in_one_line(error: BaseException) -> str:
    """Return why, in one line that is not too long; of an exception that nobody foresaw also its type and its place."""
    said = shortened(" ".join(str(error).split()))
    if isinstance(error, MemoryError):
        return f"out of memory ({said or 'no more is known'}): free some, or use a smaller map"
    # Those that say what is wrong; RCLError of rclpy is a RuntimeError.
    if said and isinstance(error, ValueError | OSError | RuntimeError | ImportError):
        return said
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {said}{place}"
