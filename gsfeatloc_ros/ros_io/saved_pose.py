"""The last good pose in a file, for the next start."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion, quaternion_from_matrix
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.common.safe_files import open_own

_VERSION = 1
# Of the file: nothing that is larger was written here.
_MAX_BYTES = 65536


def save_pose(path: Path, T_map_camera: np.ndarray, map_: Mapping[str, Any]) -> None:
    """Write a pose (4, 4) to a file, all of it or nothing.

    Args:
        path: of the file; its folder must be there.
        T_map_camera: the pose.
        map_: what tells the map, and where it lies, from others; of texts, numbers, truths and lists of numbers.

    Raises:
        OSError: it cannot be written.
    """
    saved = {
        "version": _VERSION,
        "map": dict(map_),
        "position": T_map_camera[:3, 3].tolist(),
        "orientation": quaternion_from_matrix(T_map_camera[:3, :3]).tolist(),
    }
    with replaced_file(path) as file:
        file.write(json.dumps(saved, indent=1).encode())


def load_pose(path: Path, map_: Mapping[str, Any]) -> np.ndarray:
    """Return the pose (4, 4) T_map_camera that was saved for a map.

    Raises:
        FileNotFoundError: nothing was saved.
        OSError: the file cannot be read, or another user may have written it.
        ValueError: it is damaged, or of another map; the message says so.
    """
    with open_own(path) as file:
        data = file.read(_MAX_BYTES + 1)
    try:
        saved = json.loads(data)
        if saved["version"] != _VERSION:
            raise ValueError(f"version {saved['version']}, not {_VERSION}")
        position = np.array(saved["position"], dtype=np.float64)
        orientation = np.array(saved["orientation"], dtype=np.float64)
        if position.shape != (3,) or orientation.shape != (4,) or not np.isfinite(position).all():
            raise ValueError("three finite numbers of a position and four of a quaternion are expected")
        pose = make_pose(matrix_from_quaternion(orientation), position)
        other = saved["map"]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"{path} is damaged ({type(error).__name__}: {error})") from error
    if other != json.loads(json.dumps(dict(map_))):
        raise ValueError(f"{path} is of another map, or of this one placed otherwise")
    return pose
