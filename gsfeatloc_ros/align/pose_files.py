"""Poses with stamps in files: answers and trajectories.

TUM: lines ``stamp tx ty tz qx qy qz qw``, the stamp in seconds, with commas between them if you like (what starts with
# is a comment). Of answers also the answers.csv that replay writes, whose variances count.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from gsfeatloc_ros.align.pairs import Answer
from gsfeatloc_ros.common.geometry import pose_from_numbers
from gsfeatloc_ros.common.safe_files import read_regular
from gsfeatloc_ros.common.tum import tum_fields

# Hours of odometry at 200 Hz.
_MAX_BYTES = 500_000_000
POSE_FIELDS = ("x", "y", "z", "qx", "qy", "qz", "qw")
VARIANCE_FIELDS = ("var_x", "var_y", "var_z", "var_rx", "var_ry", "var_rz")
# Nanoseconds. Stamps beyond these fit in no message.
_MAX_STAMP = 2**63


def read_answers(path: Path) -> list[Answer]:
    """Read where photos were taken: T_map_camera in a TUM file, or the answers.csv of replay.

    Raises:
        ValueError: the file cannot be read, a line is no pose, or there is none; the message says which.
    """
    lines = read_lines(path)
    if lines[0].startswith("stamp,"):
        answers = [_answer(path, number, row) for number, row in enumerate(csv.DictReader(lines), start=2) if row["x"]]
    else:
        answers = [Answer(stamp, pose, np.zeros(2)) for stamp, pose in _tum(path, lines)]
    if not answers:
        raise ValueError(f"{path}: holds no pose")
    return answers


def read_tum(path: Path) -> list[tuple[int, np.ndarray]]:
    """Read stamps in nanoseconds and poses (4, 4) of a TUM file.

    Raises:
        ValueError: as of read_answers.
    """
    poses = list(_tum(path, read_lines(path)))
    if not poses:
        raise ValueError(f"{path}: holds no pose")
    return poses


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file; raise ValueError where it cannot be read, is no text or is empty."""
    try:
        lines = read_regular(path, _MAX_BYTES).decode("utf-8-sig").splitlines()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is no text") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if not lines:
        raise ValueError(f"{path}: is empty")
    return lines


def _tum(path: Path, lines: Sequence[str]) -> Iterator[tuple[int, np.ndarray]]:
    for number, fields in tum_fields(lines):
        yield stamped_pose(path, number, fields)


def _answer(path: Path, number: int, row: dict[str, str | None]) -> Answer:
    stamp, pose = stamped_pose(path, number, [row.get(name) or "" for name in ("stamp", *POSE_FIELDS)])
    try:
        variances = np.array([float(row.get(name) or 0.0) for name in VARIANCE_FIELDS])
    except ValueError as error:
        raise ValueError(f"{path}: line {number} has variances that are no numbers") from error
    if not (np.isfinite(variances).all() and variances.min() >= 0):
        raise ValueError(f"{path}: line {number} has variances that are no finite numbers of at least 0")
    return Answer(stamp, pose, variances.reshape(2, 3).mean(axis=1))


def stamped_pose(path: Path, number: int, fields: Sequence[str]) -> tuple[int, np.ndarray]:
    """Return stamp in nanoseconds and pose of a line's fields; raise ValueError where they are none."""
    try:
        stamp = Decimal(fields[0]) * 10**9
        if not abs(stamp) < _MAX_STAMP:
            raise ValueError
        return round(stamp), pose_from_numbers([float(value) for value in fields[1:]])
    except (ValueError, InvalidOperation) as error:
        text = " ".join(fields)[:120]
        raise ValueError(f"{path}: line {number} is not `stamp x y z qx qy qz qw`: {text}") from error
