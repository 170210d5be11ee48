"""What a drive says of the similarity and what not, for people."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.align.consensus import residuals
from gsfeatloc_ros.align.fit import Fit, UndeterminedError
from gsfeatloc_ros.common.geometry import so3_log

# Beyond these a drive does not tell: as a share of the scale, and in degrees.
_OPEN_SCALE, _OPEN_ANGLE = 0.3, 20.0
# What the positions know so many times worse than both together comes from the orientations, and the other way round.
_ALONE = 4.0


@dataclass(frozen=True)
class Precision:
    """How well an alignment has to be determined.

    Attributes:
        scale: largest standard deviation of the scale, as a share of it.
        angle: largest standard deviation of the rotation about any axis, degrees.
        contradiction: largest angle between what positions and orientations say, degrees.
    """

    scale: float = 0.01
    angle: float = 1.0
    contradiction: float = 3.0


def check(fit: Fit, precision: Precision) -> None:
    """Raise UndeterminedError where a drive does not determine the similarity that well."""
    contradiction = np.degrees(fit.contradiction)
    if contradiction > precision.contradiction:
        raise UndeterminedError(
            f"the orientations are turned by {contradiction:.1f} degrees against what the positions say: is the "
            "trajectory that of the camera's optical frame? Correct --extrinsics or tf, or use --positions-only"
        )
    missing = []
    length = fit.pairs.travelled()[-1]
    if fit.scale_sigma > precision.scale:
        missing.append(
            f"the scale ({_percent(fit.scale_sigma)}; at most {100 * precision.scale:g} %): drive farther than "
            f"{length:.2f} m"
        )
    sigma, axis = fit.worst_rotation()
    if np.degrees(sigma) > precision.angle:
        direction = " ".join(f"{value:.2f}" for value in axis)
        way = "drive a curve" if fit.pairs.oriented else "drive a curve, or give orientations"
        missing.append(f"the turn about ({direction}) ({_degrees(sigma)}; at most {precision.angle:g} degrees): {way}")
    if missing:
        raise UndeterminedError(f"this drive does not tell {'; nor '.join(missing)}")


def report(fit: Fit) -> Iterator[str]:
    """Yield a short table of what was found and how well it is determined, and by what."""
    similarity, turn = fit.S_robot_map, so3_log(fit.S_robot_map.rotation)
    angle = float(np.linalg.norm(turn))
    axis = " ".join(f"{value:.3f}" for value in (turn / angle if angle else turn))
    yield f"{len(fit.pairs)} of {fit.given} photos agree, on a way of {fit.pairs.travelled()[-1]:.2f} m"
    yield f"scale {similarity.scale:.6g}, turned by {np.degrees(angle):.3f} degrees about ({axis})"
    yield f"translation {' '.join(f'{value:.4f}' for value in similarity.translation)}"
    yield f"{'standard deviation':<24}{'all':>14}{'positions':>14}{'orientations':>14}"
    sigmas = np.sqrt(fit.covariance.diagonal())
    by_positions = np.sqrt(fit.by_positions.diagonal())
    by_orientations = None if fit.by_orientations is None else np.sqrt(fit.by_orientations.diagonal())
    yield f"{'scale':<24}{_percent(sigmas[0]):>14}{_percent(by_positions[0]):>14}{'-':>14}"
    for row, name in enumerate("xyz", start=1):
        alone = "-" if by_orientations is None else _degrees(by_orientations[row])
        yield f"{f'turn about {name}':<24}{_degrees(sigmas[row]):>14}{_degrees(by_positions[row]):>14}{alone:>14}"
    for row, name in enumerate("xyz", start=4):
        yield f"{f'{name} at the centre':<24}{f'{sigmas[row]:.4f} m':>14}{f'{by_positions[row]:.4f} m':>14}{'-':>14}"
    moved, turned = (np.linalg.norm(part, axis=1) for part in residuals(fit.pairs, similarity))
    noise = f"{fit.positions.sigma:.4f} m and {fit.positions.drift:.4f} m of drift in 1 m"
    yield f"residuals of positions: median {np.median(moved):.4f} m, largest {moved.max():.4f} m; noise {noise}"
    if fit.rotations is not None:
        noise = f"{_degrees(fit.rotations.sigma)} and {_degrees(fit.rotations.drift)} of drift in 1 m"
        largest = f"median {_degrees(np.median(turned))}, largest {_degrees(turned.max())}"
        yield f"residuals of orientations: {largest}; noise {noise}"
    yield from _origins(fit)


def _origins(fit: Fit) -> Iterator[str]:
    """Yield what only one of positions and orientations says."""
    yield "the scale comes from the positions; an error of the trajectory's own scale is one of this scale too"
    if fit.by_orientations is None:
        yield "the rotation comes from the positions alone: the trajectory's orientations were not used"
        return
    total = fit.covariance[1:4, 1:4]
    for part, name, other in (
        (fit.by_positions, "orientations", "a line has no turn about itself"),
        (fit.by_orientations, "positions", "the orientations are noisier"),
    ):
        values, axes = np.linalg.eigh(part[1:4, 1:4])
        sigma = float(np.sqrt(axes[:, -1] @ total @ axes[:, -1]))
        if np.sqrt(values[-1]) > _ALONE * sigma:
            direction = " ".join(f"{value:.2f}" for value in axes[:, -1])
            yield f"the turn about ({direction}) comes from the {name} ({other})"


def _percent(share: float) -> str:
    return "undetermined" if share > _OPEN_SCALE else f"{100 * share:.3f} %"


def _degrees(radians: float) -> str:
    return "undetermined" if np.degrees(radians) > _OPEN_ANGLE else f"{np.degrees(radians):.3f} deg"
