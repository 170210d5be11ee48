"""Libraries that only the evaluation needs: the extra `evaluate` of setup.py."""

from __future__ import annotations

import importlib
from types import ModuleType


def import_extra(name: str) -> ModuleType:
    """Import a library of the extra.

    Raises:
        RuntimeError: it is not installed; the message says how to install it.
    """
    library = name.partition(".")[0]
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != library:
            raise
        raise RuntimeError(f"{library} is needed for this and is not installed: pip install {library}") from error
