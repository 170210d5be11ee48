"""YAML files that people or tools wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from gsfeatloc_ros.common.safe_files import open_regular

# Of a file: no calibration, and nothing that people write, is larger.
_MAX_BYTES = 1_000_000


def read_yaml(path: Path) -> Any:
    """Read a YAML file; of one of more than a megabyte its beginning.

    Raises:
        ValueError: it is no YAML; the message says why, in one line.
        OSError: it cannot be read, or is a folder, a pipe, a device.
    """
    try:
        with open_regular(path) as stream:
            return yaml.safe_load(stream.read(_MAX_BYTES))
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from error
