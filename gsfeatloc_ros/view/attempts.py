"""What came of images, to be shown: those of a replay's output, or of a running node as they come."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsfeatloc_ros.align.pose_files import POSE_FIELDS, VARIANCE_FIELDS, read_lines, stamped_pose
from gsfeatloc_ros.replay.bag import Role, open_bag
from gsfeatloc_ros.replay.output import POSE_TOPIC
from gsfeatloc_ros.ros_io.decode import decode_covariance, nanoseconds

_NEEDED = {"stamp", "status", "reason", *POSE_FIELDS, *VARIANCE_FIELDS}


@dataclass(frozen=True, eq=False)
class Attempt:
    """An image that was tried.

    Attributes:
        stamp: of the image, nanoseconds.
        status, reason: how it ended.
        pose: (4, 4) T_map_camera; None where there is no answer.
        covariance: (6, 6) of it in ROS order; None where it is not known.
        candidates: (N, 4, 4) poses that explain it about equally well.
        searched: (N, 4, 4) poses of the views of the map in which it was looked for; None where that is not known.
    """

    stamp: int
    status: str
    reason: str
    pose: np.ndarray | None = None
    covariance: np.ndarray | None = None
    candidates: np.ndarray | None = None
    searched: np.ndarray | None = None

    @property
    def seconds(self) -> str:
        """The stamp as people read it."""
        return f"{self.stamp / 1e9:.2f}"


@dataclass(frozen=True, eq=False)
class Prior:
    """Where the node was told to look first.

    Attributes:
        pose: (4, 4) T_map_camera, or T_map_base.
        of_base: the second.
    """

    pose: np.ndarray
    of_base: bool = False


def read_replay(folder: Path) -> list[Attempt]:
    """Read what replay wrote into a folder: answers.csv, and the covariances of the bag `answers` if it is there.

    Raises:
        ValueError: the folder has no answers.csv, or a file in it is damaged; the message says which.
    """
    path = folder / "answers.csv"
    rows = csv.DictReader(read_lines(path))
    if not set(rows.fieldnames or ()) >= _NEEDED:
        raise ValueError(f"{path}: is no answers.csv as replay writes it: name the folder of its --out")
    covariances = _covariances(folder / "answers")
    attempts = []
    for number, row in enumerate(rows, start=2):
        if row["stamp"]:
            attempts.append(_attempt(path, number, row, covariances))
    return attempts


def _attempt(path: Path, number: int, row: dict[str, str], covariances: dict[int, np.ndarray | None]) -> Attempt:
    about = (row["status"] or "", row["reason"] or "")
    identity = ["0", "0", "0", "0", "0", "0", "1"]
    fields = [row[name] or "" for name in POSE_FIELDS] if row["x"] else identity
    stamp, pose = stamped_pose(path, number, [row["stamp"], *fields])
    if not row["x"]:
        return Attempt(stamp, *about)
    return Attempt(stamp, *about, pose, covariances.get(stamp))


def _covariances(bag: Path) -> dict[int, np.ndarray | None]:
    """Return the covariances (6, 6) in a bag of answers by stamp; none where there is no such bag."""
    if not bag.exists():
        return {}
    with open_bag(bag, {Role.TRUTH: [POSE_TOPIC]}) as answers:
        messages = [recorded.message for recorded in answers.messages() if recorded.message is not None]
    return {nanoseconds(message.header.stamp): decode_covariance(message, POSE_TOPIC) for message in messages}
