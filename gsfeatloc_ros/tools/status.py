"""How a tool ends: its exit status, and what it says where it cannot go on."""

from __future__ import annotations

import sys
from collections.abc import Callable

from gsfeatloc_ros.common.words import in_one_line

# What was given cannot be used: a file, a folder, a setting. As argparse ends where an option is wrong.
UNUSABLE = 2
# As the shell has it for a program that Ctrl-C has ended.
INTERRUPTED = 130


def run_tool(name: str, run: Callable[[], int], interrupted: str = "interrupted") -> int:
    """Return the exit status of `run`; where something cannot be used, say why in one line, and return UNUSABLE.

    Args:
        name: of the tool, which the line begins with.
        run: does what the tool does, and returns its exit status.
        interrupted: what is said where the user interrupted it; the status is INTERRUPTED then.
    """
    try:
        return run()
    except (ValueError, RuntimeError, OSError) as error:
        print(f"{name}: {_reason(error)}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print(f"{name}: {interrupted}", file=sys.stderr)
        return INTERRUPTED


def _reason(error: Exception) -> str:
    """Return why, in one line; of what the system refuses, the file first, as in all other lines."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return in_one_line(error)
