"""What is measured on each query, and the summary over all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields

import numpy as np

from gsfeatloc_ros.common.geometry import rotation_error_deg, so3_log, translation_error
from gsfeatloc_ros.localize.estimate import Estimate

MAX_ROTATION_ERROR_DEG = 5.0
MAX_TRANSLATION_ERROR = 0.05  # over the radius of the trajectory
# Probabilities, in percent, of the ellipsoids in which truths are counted.
ELLIPSOIDS = (50, 90, 95)


@dataclass(frozen=True)
class QueryResult:
    """One photo localized from one prior.

    Rotation errors are in degrees, translation errors in radii of the scene's camera trajectory. A query that was not
    answered has the errors of its prior, for every method: that is all one then knows, and it is how the published
    figures count failures, so means and medians compare.

    Attributes:
        photo: file name.
        prior_rotation_error_deg, prior_translation_error: errors of the prior.
        answered: whether the method gave a pose of its own.
        success: whether the answer is within 5 degrees and 0.05.
        rotation_error_deg, translation_error: errors of the answer.
        matches, inliers, passes: as in Estimate.
        milliseconds: wall time of the call.
        reason: as in Estimate.
        step: which of the photo's priors: the repetition, or the step of a sweep.
        status: as in Estimate.
        evidence: the other plain numbers that the Estimate carries, by name; None for those that are not finite.
        stage_milliseconds: wall time of each stage, with "total", as in Estimate.
        nees: normalised estimation error squared of the answer, per degree of freedom; None without a covariance.
        in_ellipsoid: whether the ellipsoid that should hold the truth with 50, 90 and 95 % does; None without one.
    """

    photo: str
    prior_rotation_error_deg: float
    prior_translation_error: float
    answered: bool
    success: bool
    rotation_error_deg: float
    translation_error: float
    matches: int
    inliers: int
    passes: int
    milliseconds: float
    reason: str
    step: int
    status: str
    evidence: dict[str, float | None]
    stage_milliseconds: dict[str, float]
    nees: float | None
    in_ellipsoid: dict[str, bool] | None

    @property
    def verdict(self) -> str:
        """In a word: right, wrong (an answer that is no success) or none."""
        if self.answered:
            return "right" if self.success else "wrong"
        return "none"

    @property
    def relative_error(self) -> float:
        """The larger of the two errors, each over the largest that is a success: below 1 both are."""
        return max(self.rotation_error_deg / MAX_ROTATION_ERROR_DEG, self.translation_error / MAX_TRANSLATION_ERROR)


def measure(
    photo: str,
    estimate: Estimate,
    T_map_camera: np.ndarray,
    T_map_camera_prior: np.ndarray,
    radius: float,
    milliseconds: float,
    prior_is_answer: bool = False,
    step: int = 0,
) -> QueryResult:
    """Compare an estimate with the true pose `T_map_camera` (4, 4).

    Args:
        photo: file name.
        estimate: what the localizer said.
        T_map_camera: (4, 4) true pose.
        T_map_camera_prior: (4, 4) prior that the localizer was given.
        radius: radius of the camera trajectory in map units.
        milliseconds: wall time of the call.
        prior_is_answer: whether a prior that was good enough makes a failed query a success, as in the publication.
        step: which of the photo's priors it was.
    """
    answer = estimate.T_map_camera if estimate.localized else T_map_camera_prior
    rotation = rotation_error_deg(T_map_camera, answer)
    translation = translation_error(T_map_camera, answer) / radius
    close = rotation < MAX_ROTATION_ERROR_DEG and translation < MAX_TRANSLATION_ERROR
    nees = in_ellipsoid = None
    if estimate.localized and estimate.covariance is not None:
        nees = normalised_error(estimate.T_map_camera, estimate.covariance, T_map_camera)
        probability = chi_square_cdf(6 * nees)
        in_ellipsoid = {str(percent): bool(probability <= percent / 100) for percent in ELLIPSOIDS}
    return QueryResult(
        photo=photo,
        prior_rotation_error_deg=rotation_error_deg(T_map_camera, T_map_camera_prior),
        prior_translation_error=translation_error(T_map_camera, T_map_camera_prior) / radius,
        answered=estimate.localized,
        success=close and (estimate.localized or prior_is_answer),
        rotation_error_deg=rotation,
        translation_error=translation,
        matches=estimate.matches,
        inliers=estimate.inliers,
        passes=estimate.passes,
        milliseconds=milliseconds,
        reason=estimate.reason,
        step=step,
        status=estimate.status.value,
        evidence=_evidence(estimate),
        stage_milliseconds=dict(estimate.milliseconds),
        nees=nees,
        in_ellipsoid=in_ellipsoid,
    )


def normalised_error(T_map_camera: np.ndarray, covariance: np.ndarray, T_map_camera_true: np.ndarray) -> float:
    """Normalised estimation error squared (NEES) of a pose (4, 4), per degree of freedom: 1 on average if all is right.

    The error is that of the translation and the rotation vector of R R_true^T, both about the axes of the map frame, as
    the covariance (6, 6) of an Estimate is. See Bar-Shalom, Li and Kirubarajan, Estimation with Applications to
    Tracking and Navigation (2001), 5.4.2.
    """
    rotation = so3_log(T_map_camera[:3, :3] @ T_map_camera_true[:3, :3].T)
    error = np.concatenate([T_map_camera[:3, 3] - T_map_camera_true[:3, 3], rotation])
    return float(error @ np.linalg.solve(covariance, error)) / 6


def chi_square_cdf(value: float | np.ndarray) -> float | np.ndarray:
    """Probability that a chi-square variable with 6 degrees of freedom is below `value`."""
    half = 0.5 * value
    return 1 - np.exp(-half) * (1 + half + half * half / 2)


def best_of(results: Sequence[QueryResult]) -> list[QueryResult]:
    """Of each photo, the result with the smallest relative error."""
    best: dict[str, QueryResult] = {}
    for result in results:
        if result.photo not in best or result.relative_error < best[result.photo].relative_error:
            best[result.photo] = result
    return list(best.values())


def by_step(results: Sequence[QueryResult]) -> list[dict]:
    """Success rate at each step of a sweep."""
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


def summarize(results: Sequence[QueryResult]) -> dict:
    """Summary of at least one result, ready for JSON."""
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
        "nees_mean": float(nees.mean()) if len(nees) else None,
        "nees_median": float(np.median(nees)) if len(nees) else None,
        "coverage": coverage,
        "per_query": [asdict(result) for result in results],
    }


def accuracy(results: Sequence[QueryResult]) -> dict:
    """The errors of at least one result."""
    rotation = np.array([result.rotation_error_deg for result in results])
    translation = np.array([result.translation_error for result in results])
    return {
        "queries": len(results),
        "success_rate": sum(result.success for result in results) / len(results),
        "rotation_error_deg": {"mean": float(rotation.mean()), "median": float(np.median(rotation))},
        "translation_error": {"mean": float(translation.mean()), "median": float(np.median(translation))},
    }


def finite_or_none(value: float) -> float | None:
    """A number as JSON can hold it: None for NaN and infinities."""
    return float(value) if math.isfinite(value) else None


def _evidence(estimate: Estimate) -> dict[str, float | None]:
    """The plain numbers in an estimate, by name, but for those that a QueryResult has itself."""
    numbers = {}
    for field in fields(estimate):
        value = getattr(estimate, field.name)
        if isinstance(value, int | float) and field.name not in ("matches", "inliers", "passes"):
            numbers[field.name] = finite_or_none(value)
    return numbers
