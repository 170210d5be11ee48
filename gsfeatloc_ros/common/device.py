"""The device to render, match and track on.

Without gsplat a GPU is of no use, and torch is not loaded to find that out.
"""

from __future__ import annotations

import functools
import importlib.util
import logging

DEVICES = ("auto", "cpu", "cuda")

_log = logging.getLogger(__name__)


@functools.cache
def gpu_problem() -> str:
    """Return why gsplat and torch cannot use a GPU of this machine, and what to do about it; "" where they can."""
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed: pip install 'gsplat>=1.5.3,<1.6'; it needs torch for CUDA and the CUDA toolkit"
    import torch  # takes over a second, which a machine without gsplat is spared

    if torch.version.cuda is None:
        return f"torch {torch.__version__} is a build without CUDA: install one with it, see https://pytorch.org"
    if not torch.cuda.is_available():
        return f"torch {torch.__version__} finds no CUDA device: see whether nvidia-smi lists one"
    return ""


def choose_device(name: str) -> str:
    """Return the device, "cpu" or "cuda", that one of DEVICES stands for on this machine.

    "auto" is the GPU where gsplat and torch can use one; otherwise it is the CPU, and the log says why.

    Raises:
        ValueError: an unknown name.
        RuntimeError: "cuda" cannot be used; the message says what is missing and what to do.
    """
    if name not in DEVICES:
        raise ValueError(f"device {name!r} is not one of {', '.join(DEVICES)}")
    if name == "cpu":
        return "cpu"
    return device_without(gpu_problem(), name)


def device_without(problem: str, name: str) -> str:
    """Return the device that "auto" or "cuda" stands for in view of a problem of the GPU; "" for none.

    Raises:
        RuntimeError: there is a problem, and the name is "cuda".
    """
    if not problem:
        return "cuda"
    if name == "cuda":
        raise RuntimeError(f"device cuda: {problem}")
    explain_fallback(problem)
    return "cpu"


@functools.cache
def explain_fallback(problem: str) -> None:
    """Log once that the CPU is used, as a warning where a GPU was meant to be."""
    level = logging.WARNING if importlib.util.find_spec("gsplat") else logging.INFO
    _log.log(level, "rendering on the CPU: %s", problem)
