"""Priors from another system, such as a 6DGS or odometry run, in a file.

TUM: lines ``NAME tx ty tz qx qy qz qw``, with commas between them if you like (what starts with # is a comment).
CSV, with the suffix .csv: a header with the columns ``name,tx,ty,tz,qx,qy,qz,qw`` in any order. As Excel writes it, it
is read too: with a byte order mark, in UTF-16, with semicolons or tabs, and then with decimal commas.

The poses are of the camera's optical frame in the map's. NAME, for TUM usually a stamp, is the name of the photo's
file, with or without its extension.
"""

from __future__ import annotations

import codecs
import csv
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gsfeatloc_ros.common.geometry import pose_from_numbers
from gsfeatloc_ros.common.safe_files import read_regular
from gsfeatloc_ros.common.tum import tum_fields
from gsfeatloc_ros.evaluate.dataset import Scene
from gsfeatloc_ros.evaluate.protocol import PhotoPrior

# Some numbers of each of a million photos.
_MAX_BYTES = 500_000_000
_DELIMITERS = (",", ";", "\t")
_NUMBERS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def read_priors(path: Path, scene: Scene) -> list[PhotoPrior]:
    """Read the priors of a scene's photos, in the order of the photos; lines of other photos are passed over.

    A photo may have several priors, or none: it is not localized then.

    Raises:
        ValueError: the file cannot be read, a line is no pose, or no line is of a photo of the scene.
    """
    indices = {str(Path(photo.name).with_suffix("")): index for index, photo in enumerate(scene.photos)}
    indices |= {photo.name: index for index, photo in enumerate(scene.photos)}
    poses = []
    try:
        lines = _text(read_regular(path, _MAX_BYTES)).splitlines()
        for number, name, values in _csv_lines(lines) if path.suffix.lower() == ".csv" else _tum_lines(lines):
            if name in indices:
                poses.append((indices[name], _pose(number, values)))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if not poses:
        raise ValueError(f"{path}: no line is of a photo of {scene.name}; they are named like {scene.photos[0].name}")
    seen: Counter[int] = Counter()
    priors = []
    for index, pose in sorted(poses, key=lambda pair: pair[0]):
        priors.append(PhotoPrior(index, seen[index], pose))
        seen[index] += 1
    return priors


def _text(data: bytes) -> str:
    """Return the text of a file by its byte order mark; without one it is UTF-8."""
    return data.decode("utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig")


def _tum_lines(lines: Sequence[str]) -> Iterator[tuple[int, str, list[str]]]:
    """Yield number, name and the seven values of each line."""
    for number, (name, *values) in tum_fields(lines):
        yield number, name, values


def _csv_lines(lines: Sequence[str]) -> Iterator[tuple[int, str, list[str]]]:
    # Excel's own way to name the delimiter.
    first = int(bool(lines) and lines[0].lower().startswith("sep="))
    header = lines[first] if len(lines) > first else ""
    delimiter = max(_DELIMITERS, key=header.count)
    reader = csv.DictReader(lines[first:], delimiter=delimiter, skipinitialspace=True)
    reader.fieldnames = [name.strip().lower() for name in reader.fieldnames or ()]
    missing = [name for name in ("name", *_NUMBERS) if name not in reader.fieldnames]
    if missing:
        raise ValueError(f"the header lacks {', '.join(missing)}")
    for row in reader:
        values = [row[name] for name in _NUMBERS]
        if delimiter != ",":
            values = [value and value.replace(",", ".") for value in values]
        yield first + reader.line_num, row["name"].strip(), values


def _pose(number: int, values: list[str]) -> np.ndarray:
    """Return T_map_camera (4, 4) from the fields of a line."""
    try:
        return pose_from_numbers([float(value) for value in values])
    except (TypeError, ValueError) as error:
        raise ValueError(f"line {number} does not hold a pose, {' '.join(_NUMBERS)}: {values}") from error
