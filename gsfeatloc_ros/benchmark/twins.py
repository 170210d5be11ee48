"""How often a photo of one of two rooms that are nearly alike is localized in the right one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import rotation_error_deg, translation_error
from gsfeatloc_ros.index import IndexOptions, build_index
from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.match import DEFAULT_MATCHER, create_matcher
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.simulate import Room
from gsfeatloc_ros.simulate.twin_rooms import TwinPhoto, TwinRooms

_CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 322.0], [0.0, 502.0, 236.0], [0.0, 0.0, 1.0]]))
# Rows of the table: the share of a photo's pixels that the other room does not show, from so much on.
_SHARES = (0.0, 1e-9, 0.0025, 0.005, 0.01, 0.02)
# A pose within so many degrees and metres is right.
_MAX_ERRORS = (1.0, 0.02)
_OUTCOMES = ("right", "ambiguous", "wrong", "none")


def measure_twins(shares: Sequence[float], photos: int, seed: int = 0) -> list[dict[str, Any]]:
    """Localize photos of twin rooms without a prior.

    Args:
        shares: of the second room's surfaces that posters cover; each makes a world of its own.
        photos: of each world, half of them in each room.
        seed: of worlds, photos and indices.

    Returns:
        A row for each photo: "share" of the posters, "different", the share of its own pixels that the other room does
        not show, and "outcome": "right", "wrong", "ambiguous" (both places, and no other), or "none".
    """
    rows, room, matcher = [], Room(seed), create_matcher(DEFAULT_MATCHER)
    for share in shares:
        world = TwinRooms(room, share, seed)
        renderer = create_renderer(world.cover())
        index = build_index(renderer, matcher, IndexOptions(seed=seed))
        localizer = Localizer(renderer, matcher, index=index)
        for photo in tqdm(world.photos(_CAMERA, photos, seed), desc=f"{share:.1%} posters", unit="photo", disable=None):
            outcome = judge(localizer.localize(photo.image, _CAMERA), photo)
            rows.append({"share": share, "different": photo.different, "outcome": outcome})
    return rows


def judge(estimate: Estimate, photo: TwinPhoto) -> str:
    """Return which outcome an estimate is."""
    here, there = photo.poses
    if estimate.T_map_camera is not None:
        return "right" if _is_near(estimate.T_map_camera, here) else "wrong"
    if estimate.status is not Status.AMBIGUOUS:
        return "none"
    found = [(_is_near(pose, here), _is_near(pose, there)) for pose in estimate.candidates]
    return "ambiguous" if sorted(found) == [(False, True), (True, False)] else "wrong"


def twins_table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the number of photos of each outcome, by the share of their pixels that differs."""
    lines = ["different pixels  photos  " + "  ".join(f"{outcome:>9}" for outcome in _OUTCOMES)]
    for low, high in zip(_SHARES, (*_SHARES[1:], np.inf), strict=True):
        counts = Counter(row["outcome"] for row in rows if low <= row["different"] < high)
        name = "none" if low == 0 else f"{low:.2%} and more" if np.isinf(high) else f"{low:.2%} to {high:.2%}"
        numbers = "  ".join(f"{counts[outcome]:>9}" for outcome in _OUTCOMES)
        lines.append(f"{name:16}  {counts.total():>6}  {numbers}")
    return "\n".join(lines)


def _is_near(pose: np.ndarray, truth: np.ndarray) -> bool:
    return rotation_error_deg(pose, truth) < _MAX_ERRORS[0] and translation_error(pose, truth) < _MAX_ERRORS[1]
