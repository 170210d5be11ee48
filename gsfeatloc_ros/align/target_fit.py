"""The scale by targets of known size: where they are in the map, and how large, by where their corners are seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import least_squares

from gsfeatloc_ros.align.alignment import Alignment
from gsfeatloc_ros.align.fit import UndeterminedError
from gsfeatloc_ros.align.target import Sighting, Target
from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp, so3_log, transform
from gsfeatloc_ros.maps.similarity import Similarity

# Pixels. Corners that are farther off count less.
_LOSS_SCALE = 1.0
# Square pixels. No detector is better.
_LEAST_VARIANCE = 1e-4
MIN_VIEWS = 2
"""Of a target; one alone shows no size."""


@dataclass(frozen=True, eq=False)
class TargetFit:
    """Where targets are.

    Attributes:
        units: map units in one metre.
        sigma: standard deviation of that, as a share of it.
        S_map_target: of each target by its number.
        sightings: number of them.
        residual: median distance of corners in pixels.
    """

    units: float
    sigma: float
    S_map_target: dict[int, Similarity]
    sightings: int
    residual: float


def fit_targets(target: Target, sightings: Sequence[Sighting]) -> TargetFit:
    """Find size and place of all targets that are seen at least MIN_VIEWS times.

    Raises:
        UndeterminedError: there is none, or their photos were taken from one place.
    """
    counts = [sighting.number for sighting in sightings]
    numbers = sorted({number for number in counts if counts.count(number) >= MIN_VIEWS})
    kept = [sighting for sighting in sightings if sighting.number in numbers]
    if not numbers:
        raise UndeterminedError(
            f"no target was seen in at least {MIN_VIEWS} photos ({len(sightings)} sightings): check its family or "
            "numbers, and that localized photos show it large and sharp"
        )
    kept, start = _start(target, kept, numbers)
    solved = least_squares(_residuals, start, loss="soft_l1", f_scale=_LOSS_SCALE, x_scale="jac", args=(target, kept))
    off = np.linalg.norm(_residuals(solved.x, target, kept).reshape(-1, 2), axis=1)
    # What photos from one place leave open has a deviation of all that it may be, and not none.
    freedom = max(2 * len(off) - len(start), 1)
    # Cameras' poses are off together for all corners of a photo: the photos count, not the corners.
    variance = float(np.sum(np.minimum(off, 3 * np.median(off) + 1e-9) ** 2)) / freedom * len(target.corners)
    wide = np.array([1.0, *[np.pi, np.pi, np.pi, 1e3, 1e3, 1e3] * len(numbers)])
    information = solved.jac.T @ solved.jac / max(variance, _LEAST_VARIANCE) * np.outer(wide, wide)
    sigma = float(np.sqrt(np.linalg.inv(information + np.eye(len(wide)))[0, 0]))
    places = {
        number: Similarity(float(np.exp(solved.x[0])), so3_exp(place[:3]), place[3:])
        for number, place in zip(numbers, solved.x[1:].reshape(-1, 6), strict=True)
    }
    return TargetFit(float(np.exp(solved.x[0])), sigma, places, len(kept), float(np.median(off)))


def scale_by_targets(fit: TargetFit, largest_sigma: float, T_robot_tag: np.ndarray | None) -> Alignment:
    """Return the scale by targets; with the pose (4, 4) of the only one in the robot's frame, the whole similarity.

    Raises:
        UndeterminedError: the scale is less certain than `largest_sigma`, a share of it.
        ValueError: there is a pose, and several targets.
    """
    if fit.sigma > largest_sigma:
        raise UndeterminedError(
            f"the targets tell the scale only to {100 * fit.sigma:.2f} % (at most {100 * largest_sigma:g}): take "
            "photos that show them larger, from places that are farther apart"
        )
    report = [
        f"scale {1 / fit.units:.6g}, standard deviation {100 * fit.sigma:.3f} %",
        f"{fit.sightings} sightings of {len(fit.S_map_target)} targets; corners {fit.residual:.2f} pixels off (median)",
    ]
    if T_robot_tag is None:
        report.append("rotation and translation are only scaled")
        return Alignment(Similarity(1 / fit.units), complete=False, report=report)
    if len(fit.S_map_target) > 1:
        raise ValueError(f"--tag-pose is of one tag, and {len(fit.S_map_target)} were seen: say which by --tag-id")
    (S_map_target,) = fit.S_map_target.values()
    report.append("rotation and translation come from the pose of the tag")
    S_robot_tag = Similarity(1.0, T_robot_tag[:3, :3], T_robot_tag[:3, 3])
    return Alignment(S_robot_tag @ S_map_target.inverse(), complete=True, report=report)


def _residuals(x: np.ndarray, target: Target, sightings: Sequence[Sighting]) -> np.ndarray:
    """Return by how many pixels corners are off (2 K S,); x is the log of the scale, then 6 of each target."""
    numbers = sorted({sighting.number for sighting in sightings})
    places = dict(zip(numbers, x[1:].reshape(-1, 6), strict=True))
    off = []
    for sighting in sightings:
        place = places[sighting.number]
        points = Similarity(float(np.exp(x[0])), so3_exp(place[:3]), place[3:]).transform(target.corners)
        in_camera = transform(invert(sighting.view.T_map_camera), points)
        off.append(sighting.view.camera.project(in_camera) - sighting.pixels)
    return np.concatenate(off).ravel()


def _start(target: Target, sightings: Sequence[Sighting], numbers: Sequence[int]) -> tuple[list[Sighting], np.ndarray]:
    """Return the sightings, their corners in one order, and where to begin.

    Each photo says where a target is but for one factor that all share: c + units * direction is the same of all.
    """
    rotations: dict[int, np.ndarray] = {}
    kept, rows, right = [], [], []
    for sighting in sightings:
        turned, T_camera_target = _nearest_turn(target, sighting, rotations.get(sighting.number))
        kept.append(turned)
        T_map_camera = sighting.view.T_map_camera
        rotations.setdefault(sighting.number, T_map_camera[:3, :3] @ T_camera_target[:3, :3])
        row = np.zeros((3, 1 + 3 * len(numbers)))
        row[:, 0] = -T_map_camera[:3, :3] @ T_camera_target[:3, 3]
        place = 1 + 3 * numbers.index(sighting.number)
        row[:, place : place + 3] = np.eye(3)
        rows.append(row)
        right.append(T_map_camera[:3, 3])
    solved = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    if not solved[0] > 0:
        raise UndeterminedError("the photos of the targets were taken from one place: take some from others")
    places = [
        np.concatenate([so3_log(rotations[number]), solved[1 + 3 * place : 4 + 3 * place]])
        for place, number in enumerate(numbers)
    ]
    return kept, np.concatenate([[np.log(solved[0])], *places])


def _nearest_turn(target: Target, sighting: Sighting, R_map_target: np.ndarray | None) -> tuple[Sighting, np.ndarray]:
    """Return a sighting and T_camera_target (4, 4), metres, turned so as to be most like a rotation that is known."""
    best, best_turn = None, np.inf
    K = sighting.view.camera.pinhole().K
    for order in target.turns:
        pixels = sighting.pixels[order]
        _, turns, positions, off = cv2.solvePnPGeneric(target.corners, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
        for turn, position, error in zip(turns, positions, np.ravel(off), strict=True):
            pose = make_pose(so3_exp(turn.ravel()), position.ravel())
            # The first solution is the better one; without a rotation that is known it counts.
            away = float(error)
            if R_map_target is not None:
                R = sighting.view.T_map_camera[:3, :3] @ pose[:3, :3]
                away = float(np.linalg.norm(so3_log(R_map_target.T @ R)))
            if away < best_turn:
                best, best_turn = (replace(sighting, pixels=pixels), pose), away
    if best is None:
        raise UndeterminedError("no pose explains a target that was seen")
    return best
