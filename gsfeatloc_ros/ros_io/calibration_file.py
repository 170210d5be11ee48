"""A camera's calibration in a file, as camera_calibration and camera_info_manager write it (YAML)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsfeatloc_ros.common.yaml_file import read_yaml
from gsfeatloc_ros.ros_io.calibration import decode_camera
from gsfeatloc_ros.ros_io.message_types import Header, RegionOfInterest, Time


@dataclass
class _Stamp:
    sec: int = 0
    nanosec: int = 0


@dataclass
class _Header:
    stamp: Time = field(default_factory=_Stamp)
    frame_id: str = ""


@dataclass
class _Region:
    x_offset: int = 0
    y_offset: int = 0
    height: int = 0
    width: int = 0
    do_rectify: bool = False


@dataclass
class FileCameraInfo:
    """What a CameraInfo holds, from a file."""

    width: int
    height: int
    distortion_model: str
    d: Sequence[float] | np.ndarray
    k: Sequence[float] | np.ndarray
    r: Sequence[float] | np.ndarray
    p: Sequence[float] | np.ndarray
    header: Header = field(default_factory=_Header)
    binning_x: int = 0
    binning_y: int = 0
    roi: RegionOfInterest = field(default_factory=_Region)


def read_calibration(path: Path, rectified: bool = False) -> FileCameraInfo:
    """Read a calibration, as a message that `decode_camera` takes.

    Args:
        path: of the file.
        rectified: whether the images are.

    Raises:
        ValueError: the file cannot be read, is none, or is of no camera that can be used; the message says why.
    """
    calibration = _read(path)
    try:
        decode_camera(calibration, rectified)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return calibration


def _read(path: Path) -> FileCameraInfo:
    """Return what a file holds, whatever that is worth."""
    try:
        content = read_yaml(path)
        if not isinstance(content, dict):
            raise ValueError("it is no mapping")
        return FileCameraInfo(
            int(content["image_width"]),
            int(content["image_height"]),
            str(content.get("distortion_model", "")),
            _numbers(content, "distortion_coefficients"),
            _numbers(content, "camera_matrix", 9),
            _numbers(content, "rectification_matrix", 9),
            _numbers(content, "projection_matrix", 12),
        )
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except KeyError as error:
        raise ValueError(
            f"{path}: lacks the key {error}: a calibration as camera_calibration writes it is expected"
        ) from error
    except (TypeError, ValueError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: is no calibration as camera_calibration writes it: {reason}") from error


def _numbers(content: dict, key: str, count: int | None = None) -> list[float]:
    """Return the data of a matrix; where it is not needed and not there, zeros."""
    if key not in content and key in ("rectification_matrix", "projection_matrix"):
        return [0.0] * (count or 0)
    data = [float(number) for number in content[key]["data"]]
    if count is not None and len(data) != count:
        raise ValueError(f"{key} has {len(data)} numbers, not {count}")
    return data
