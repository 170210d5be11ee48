"""Measures of each query, and the summary over all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gsfeatloc_ros.common.geometry import rotation_error_deg, so3_log, translation_error
from gsfeatloc_ros.evaluate.dataset import PosedPhoto
from gsfeatloc_ros.evaluate.protocol import PhotoPrior
from gsfeatloc_ros.localize.estimate import Estimate
from gsfeatloc_ros.localize.evidence import Evidence

MAX_ROTATION_ERROR_DEG = 5.0
MAX_TRANSLATION_ERROR = 0.05  # in radii of the trajectory
# Probabilities, in percent, of the ellipsoids in which truths are counted.
ELLIPSOIDS = (50, 90, 95)


@dataclass(frozen=True)
class Scoring:
    """How answers are scored.

    Attributes:
        radius: of the scene's camera trajectory in map units, which translation errors are divided by.
        prior_is_answer: whether a prior that was good enough makes a failed query a success, as in the publication.
        negative: whether the photo is not of the scene, so that every answer is wrong.
    """

    radius: float
    prior_is_answer: bool = False
    negative: bool = False


@dataclass(frozen=True)
class Cost:
    """Time of a localization in milliseconds: on the clock, and of all of the process's threads."""

    milliseconds: float
    cpu_milliseconds: float


@dataclass(frozen=True)
class QueryResult:
    """One photo localized from one prior.

    Rotation errors are in degrees, translation errors in radii of the scene's camera trajectory. A query that was not
    answered has the errors of its prior, for every method: that is all one then knows, and it is how the published
    figures count failures, so means and medians compare.

    Attributes:
        photo: its name.
        step: number of the prior among the photo's.
        prior_rotation_error_deg, prior_translation_error: errors of the prior.
        answered: whether the method gave a pose of its own.
        success: whether the answer is within 5 degrees and 0.05; of a negative, that there is none.
        rotation_error_deg, translation_error: errors of the answer. Of a negative, from the photo that it stands for:
            they say nothing.
        status, reason: as in Estimate.
        evidence: of the Estimate, by name; None for what could not be measured.
        milliseconds: wall time of the call.
        cpu_milliseconds: CPU time of the call.
        stage_milliseconds: wall time of each stage, with "total", as in Estimate.
        nees: normalised estimation error squared of the answer, per degree of freedom; None without a covariance.
        in_ellipsoid: whether the ellipsoid that should hold the truth with 50, 90 and 95 % does; None without one.
        protection_exceeded: whether the answer is farther off than its protection level says; None without one.
    """

    photo: str
    step: int
    prior_rotation_error_deg: float
    prior_translation_error: float
    answered: bool
    success: bool
    rotation_error_deg: float
    translation_error: float
    status: str
    reason: str
    evidence: dict[str, int | float | None]
    milliseconds: float
    cpu_milliseconds: float
    stage_milliseconds: dict[str, float]
    nees: float | None
    in_ellipsoid: dict[str, bool] | None
    protection_exceeded: bool | None

    @property
    def verdict(self) -> str:
        """The result in a word: right, wrong (an answer that is no success) or none."""
        if self.answered:
            return "right" if self.success else "wrong"
        return "none"

    @property
    def relative_error(self) -> float:
        """The larger of the two errors, each over the largest that is a success: below 1 both are within it."""
        return max(self.rotation_error_deg / MAX_ROTATION_ERROR_DEG, self.translation_error / MAX_TRANSLATION_ERROR)


def measure(photo: PosedPhoto, prior: PhotoPrior, estimate: Estimate, cost: Cost, scoring: Scoring) -> QueryResult:
    """Compare an estimate with the true pose of the photo.

    Args:
        photo: with its true pose.
        prior: that the localizer was given.
        estimate: the localizer's.
        cost: of the call.
        scoring: how it is scored.
    """
    truth = photo.T_map_camera
    answered = estimate.T_map_camera is not None
    answer = prior.T_map_camera if estimate.T_map_camera is None else estimate.T_map_camera
    rotation = rotation_error_deg(truth, answer)
    translation = translation_error(truth, answer) / scoring.radius
    close = rotation < MAX_ROTATION_ERROR_DEG and translation < MAX_TRANSLATION_ERROR
    nees = in_ellipsoid = exceeded = None
    if estimate.covariance is not None and not scoring.negative:
        nees = normalised_error(answer, estimate.covariance, truth)
        probability = chi_square_cdf(np.array(6 * nees))
        in_ellipsoid = {str(percent): bool(probability <= percent / 100) for percent in ELLIPSOIDS}
        exceeded = _exceeds_protection(truth, estimate)
    return QueryResult(
        photo=photo.name,
        step=prior.step,
        prior_rotation_error_deg=rotation_error_deg(truth, prior.T_map_camera),
        prior_translation_error=translation_error(truth, prior.T_map_camera) / scoring.radius,
        answered=answered,
        success=not answered if scoring.negative else close and (answered or scoring.prior_is_answer),
        rotation_error_deg=rotation,
        translation_error=translation,
        status=estimate.status.value,
        reason=estimate.reason,
        evidence=finite_numbers(estimate.evidence),
        milliseconds=cost.milliseconds,
        cpu_milliseconds=cost.cpu_milliseconds,
        stage_milliseconds=dict(estimate.milliseconds),
        nees=nees,
        in_ellipsoid=in_ellipsoid,
        protection_exceeded=exceeded,
    )


def _exceeds_protection(truth: np.ndarray, estimate: Estimate) -> bool | None:
    """Return whether an answer is farther from the true pose (4, 4) than its protection level; None without one."""
    level = estimate.protection
    if level is None or estimate.T_map_camera is None:
        return None
    rotation = np.radians(rotation_error_deg(truth, estimate.T_map_camera))
    return bool(translation_error(truth, estimate.T_map_camera) > level.radius or rotation > level.angle)


def finite_numbers(evidence: Evidence) -> dict[str, int | float | None]:
    """Return the numbers of the evidence as JSON can hold them: None for what could not be measured."""
    return {name: number if math.isfinite(number) else None for name, number in evidence.numbers().items()}


def normalised_error(T_map_camera: np.ndarray, covariance: np.ndarray, T_map_camera_true: np.ndarray) -> float:
    """Return the normalised estimation error squared (NEES) of a pose (4, 4) per degree of freedom.

    It is 1 on average where the covariance is right.

    The error is that of the translation and the rotation vector of R R_true^T, both about the axes of the map frame, as
    the covariance (6, 6) of an Estimate is. See Bar-Shalom, Li and Kirubarajan, Estimation with Applications to
    Tracking and Navigation (2001), 5.4.2.
    """
    rotation = so3_log(T_map_camera[:3, :3] @ T_map_camera_true[:3, :3].T)
    error = np.concatenate([T_map_camera[:3, 3] - T_map_camera_true[:3, 3], rotation])
    return float(error @ np.linalg.solve(covariance, error)) / 6


def chi_square_cdf(values: np.ndarray) -> np.ndarray:
    """Return the probabilities that a chi-square variable with 6 degrees of freedom is below `values`."""
    half = 0.5 * values
    return 1 - np.exp(-half) * (1 + half + half * half / 2)


def best_of(results: Sequence[QueryResult]) -> list[QueryResult]:
    """Return, of each photo, the result with the smallest relative error."""
    best: dict[str, QueryResult] = {}
    for result in results:
        if result.photo not in best or result.relative_error < best[result.photo].relative_error:
            best[result.photo] = result
    return list(best.values())


def by_step(results: Sequence[QueryResult]) -> list[dict[str, Any]]:
    """Return the success rate at each step of a sweep, ready for JSON."""
    steps = []
    for step in sorted({result.step for result in results}):
        chosen = [result for result in results if result.step == step]
        steps.append(
            {
                "prior_rotation_error_deg": float(np.mean([result.prior_rotation_error_deg for result in chosen])),
                "prior_translation_error": float(np.mean([result.prior_translation_error for result in chosen])),
                "queries": len(chosen),
                "success_rate": sum(result.success for result in chosen) / len(chosen),
                "wrong_answers": sum(result.verdict == "wrong" for result in chosen),
            }
        )
    return steps


def summarize(results: Sequence[QueryResult]) -> dict[str, Any]:
    """Return the summary of at least one result, ready for JSON."""
    milliseconds = np.array([result.milliseconds for result in results])
    nees = np.array([result.nees for result in results if result.nees is not None])
    coverage = None
    if len(nees):
        coverage = {str(percent): float(np.mean(chi_square_cdf(6 * nees) <= percent / 100)) for percent in ELLIPSOIDS}
    return {
        **accuracy(results),
        "answered": sum(result.answered for result in results),
        "wrong_answers": sum(result.verdict == "wrong" for result in results),
        "milliseconds": {"median": float(np.median(milliseconds)), "p95": float(np.percentile(milliseconds, 95))},
        "cpu_milliseconds": {"median": float(np.median([result.cpu_milliseconds for result in results]))},
        "nees_mean": float(nees.mean()) if len(nees) else None,
        "nees_median": float(np.median(nees)) if len(nees) else None,
        "coverage": coverage,
        "protection_exceeded": sum(bool(result.protection_exceeded) for result in results),
        "per_query": [asdict(result) for result in results],
    }


def accuracy(results: Sequence[QueryResult]) -> dict[str, Any]:
    """Return the errors of at least one result, ready for JSON."""
    rotation = np.array([result.rotation_error_deg for result in results])
    translation = np.array([result.translation_error for result in results])
    return {
        "queries": len(results),
        "success_rate": sum(result.success for result in results) / len(results),
        "rotation_error_deg": {"mean": float(rotation.mean()), "median": float(np.median(rotation))},
        "translation_error": {"mean": float(translation.mean()), "median": float(np.median(translation))},
    }
