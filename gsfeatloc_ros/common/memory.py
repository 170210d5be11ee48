"""How much memory is left: of the machine, of the container or service, of the process."""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Iterator
from pathlib import Path

_PROC, _CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")


def available_memory(proc: Path = _PROC, cgroups: Path = _CGROUPS) -> int:
    """Return how many bytes this process can take before it, or another for it, is ended: the least of all limits.

    Args:
        proc, cgroups: where Linux tells of itself.
    """
    return max(0, min(_limits(proc, cgroups)))


def _limits(proc: Path, cgroups: Path) -> Iterator[int]:
    yield 1024 * _number(proc / "meminfo", "MemAvailable:", 2**53)
    # Of version 2, of this group and those it is in; "max" is no number.
    for group in _groups(proc, cgroups):
        with contextlib.suppress(OSError, ValueError):
            limit = int((group / "memory.max").read_text())
            used = int((group / "memory.current").read_text())
            # Of files, which is given back when it is needed.
            yield limit - used + _number(group / "memory.stat", "inactive_file", 0)
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    if most != resource.RLIM_INFINITY:
        yield most - 1024 * _number(proc / "self" / "status", "VmSize:", 0)


def _groups(proc: Path, cgroups: Path) -> Iterator[Path]:
    with contextlib.suppress(OSError):
        for line in (proc / "self" / "cgroup").read_text().splitlines():
            if line.startswith("0::/"):
                group = cgroups / line.removeprefix("0::/")
                yield group
                yield from (parent for parent in group.parents if cgroups in (parent, *parent.parents))


def _number(path: Path, name: str, otherwise: int) -> int:
    """Return the number behind a name in a file of lines."""
    with contextlib.suppress(OSError, ValueError):
        for line in path.read_text().splitlines():
            words = line.split()
            if words and words[0] == name:
                return int(words[1])
    return otherwise
