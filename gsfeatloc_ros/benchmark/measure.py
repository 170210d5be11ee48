"""Time, memory and the machine they were measured on.

CPU time counts all threads of the process; on a shared machine it, and ratios within one run, mean more than wall time.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")


@dataclass(frozen=True)
class Timed(Generic[T]):
    """What a call returned, and the milliseconds that it took."""

    result: T
    cpu: float
    wall: float


def timed(function: Callable[..., T], *arguments: object) -> Timed[T]:
    """Call `function` with `arguments`, with the time that takes."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = function(*arguments)
    return Timed(result, 1e3 * (time.process_time() - cpu), 1e3 * (time.perf_counter() - wall))


def finish(device: str) -> None:
    """Wait until a device (Renderer.device) has done all that was asked of it: calls of a GPU return before that."""
    if device != "cpu":
        import torch

        torch.cuda.synchronize()


def stage_time(device: str) -> tuple[str, Callable[[], float]]:
    """Return by which time the stages of work on a device are measured, "cpu" or "wall", and its clock, in seconds.

    It is the CPU's where the CPU works; on a GPU the wall time, as CPU time would leave the work out.
    """
    if device == "cpu":
        return "cpu", time.process_time

    def now() -> float:
        finish(device)
        return time.perf_counter()

    return "wall", now


def spread(milliseconds: Sequence[float]) -> dict[str, float]:
    """Return the smallest and the median of several measurements of the same."""
    return {"min": min(milliseconds), "median": float(np.median(milliseconds))}


@dataclass
class Memory:
    """Megabytes of the process's memory beyond what it took at first: at most, and at the end."""

    peak: float = 0.0
    after: float = 0.0


@contextmanager
def memory_taken() -> Iterator[Memory]:
    """Watch what memory the block takes; the figures are there when it is left (Linux)."""
    taken = Memory()
    # Makes the highest value start again from the present one: proc(5).
    Path("/proc/self/clear_refs").write_text("5")
    before = status_megabytes("VmRSS")
    yield taken
    taken.peak = status_megabytes("VmHWM") - before
    taken.after = status_megabytes("VmRSS") - before


def machine() -> dict[str, str | int]:
    """Return what the figures were measured on."""
    models = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return {
        "cpu": models[0].partition(":")[2].strip() if models else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
    }


def status_megabytes(field: str) -> float:
    """Return a field of the process's status, as VmRSS, in megabytes (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field + ":")) / 1024
