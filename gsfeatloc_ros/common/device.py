"""On what to render and match; without gsplat a GPU is of no use, and torch is not loaded to find that out."""

from __future__ import annotations

import functools
import importlib.util
import logging

DEVICES = ("auto", "cpu", "cuda")

_log = logging.getLogger(__name__)


@functools.cache
def gpu_problem() -> str:
    """Why GpuRenderer cannot be used on this machine and what to do about it; empty where it can."""
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed: pip install 'gsplat>=1.5.3,<1.6'; it needs torch for CUDA and the CUDA toolkit"
    import torch  # takes over a second, which a machine without gsplat is spared

    if torch.version.cuda is None:
        return f"torch {torch.__version__} is a build without CUDA: install one with it, see https://pytorch.org"
    if not torch.cuda.is_available():
        return f"torch {torch.__version__} finds no CUDA device: see whether nvidia-smi lists one"
    from gsfeatloc_ros.render.gpu import self_check

    return self_check("cuda")


def chosen_device(device: str) -> str:
    """The device that a name of DEVICES stands for here: "cpu" or "cuda".

    Raises:
        ValueError: an unknown name.
        RuntimeError: "cuda" cannot be used; the message says what is missing and what to do.
    """
    if device not in DEVICES:
        raise ValueError(f"renderer device {device!r} is not one of {', '.join(DEVICES)}")
    problem = "" if device == "cpu" else gpu_problem()
    if device == "cuda" and problem:
        raise RuntimeError(f"renderer device cuda: {problem}")
    if problem:
        explain_fallback(problem)
    return "cpu" if device == "cpu" or problem else "cuda"


@functools.cache
def explain_fallback(problem: str) -> None:
    """Say once that rendering is on the CPU, as a warning where a GPU was meant to be used."""
    level = logging.WARNING if importlib.util.find_spec("gsplat") else logging.INFO
    _log.log(level, "rendering on the CPU: %s", problem)
