"""What is measured on each query, and the summary over all."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from gsfeatloc_ros.estimate import Estimate
from gsfeatloc_ros.geometry import rotation_error_deg, translation_error

MAX_ROTATION_ERROR_DEG = 5.0
MAX_TRANSLATION_ERROR = 0.05  # over the radius of the trajectory


@dataclass(frozen=True)
class QueryResult:
    """One photo localized.

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


def measure(
    photo: str,
    estimate: Estimate,
    T_map_camera: np.ndarray,
    T_map_camera_prior: np.ndarray,
    radius: float,
    milliseconds: float,
    prior_is_answer: bool = False,
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
    """
    answer = estimate.T_map_camera if estimate.localized else T_map_camera_prior
    rotation = rotation_error_deg(T_map_camera, answer)
    translation = translation_error(T_map_camera, answer) / radius
    close = rotation < MAX_ROTATION_ERROR_DEG and translation < MAX_TRANSLATION_ERROR
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
    )


def summarize(results: list[QueryResult]) -> dict:
    """Summary of at least one result, ready for JSON."""
    rotation = np.array([result.rotation_error_deg for result in results])
    translation = np.array([result.translation_error for result in results])
    milliseconds = np.array([result.milliseconds for result in results])
    return {
        "queries": len(results),
        "success_rate": sum(result.success for result in results) / len(results),
        "rotation_error_deg": {"mean": float(rotation.mean()), "median": float(np.median(rotation))},
        "translation_error": {"mean": float(translation.mean()), "median": float(np.median(translation))},
        "answered": sum(result.answered for result in results),
        "wrong_answers": sum(result.answered and not result.success for result in results),
        "milliseconds": {"median": float(np.median(milliseconds)), "p95": float(np.percentile(milliseconds, 95))},
        "per_query": [asdict(result) for result in results],
    }
