"""JSON files of unknown origin."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gsfeatloc_ros.common.safe_files import read_regular

# Poses of a hundred thousand photos.
_MAX_BYTES = 100_000_000
# Digits of a whole number; a longer one becomes a float, perhaps an infinite one.
_MAX_DIGITS = 18


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        ValueError: it is no JSON, or too large.
        OSError: it cannot be read, or is a folder, a pipe, a device.
    """
    data = read_regular(path, _MAX_BYTES)
    try:
        return json.loads(data, parse_int=lambda digits: (int if len(digits) <= _MAX_DIGITS else float)(digits))
    except RecursionError as error:
        raise ValueError("is nested too deeply") from error
