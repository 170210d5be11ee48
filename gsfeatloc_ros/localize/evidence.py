"""What speaks for an estimate and what against it: the map's render at the estimate must match the photo."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.geometry import so3_log
from gsfeatloc_ros.common.local_structure import local_structure
from gsfeatloc_ros.common.parameter import parameter
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.render.base import Render

# Corners may be off by this many times the median error, up to this many times the reprojection error allowed.
_BLUR_TOLERANCE_MEDIANS = 4.0
_MAX_BLUR_TOLERANCE = 2.0
# Coverage is counted in this many cells across and down the photo.
_COVERAGE_CELLS = (8, 6)
# Photo and render are compared at this width: finer detail splats do not draw, and a mirror image has the coarser too.
_COMPARED_WIDTH = 320
# Standard deviation, in compared pixels, of the neighbourhood whose mean brightness and contrast are taken out.
_NEIGHBOURHOOD = 6.0
# Contrast (of 255) under which a neighbourhood says nothing: sky, a blank wall.
_MIN_CONTRAST = 2.0
# Pixels that are compared must be covered by the map, and seen by the lens.
_MIN_ALPHA = 0.9
_MIN_COVERED = 0.5
_MIN_COMPARED_SHARE = 0.05
# The least variance of a prior, as a share of the variance of a prior that comes without covariance: priors may claim
# to know a coordinate exactly, as RViz's planar ones do.
_MIN_VARIANCE_SHARE = 0.01


@dataclass(frozen=True)
class Evidence:
    """The numbers behind an estimate. NaN stands for what could not be measured.

    Attributes:
        corners: number of the photo's corners that were looked for in the last render.
        matches: number of those that were found; of feature matches where no pose was found.
        lifted: number of those that have a depth that can be trusted.
        inliers: number of those that agree with the pose; 0 without pose.
        inlier_ratio: share of the lifted ones that agrees, with some allowance for blur.
        coverage: share of the photo's cells, in a grid of 8 x 6, that hold an inlier.
        correlation: of photo and render at the estimate, in [-1, 1].
        reprojection_error_px: RMS of the inliers' reprojection errors in pixels of the localized photo.
        deviation: distance of the pose from the prior in standard deviations of the prior.
        passes: number of renders at estimates.
        views: number of other views than the prior's that were searched.
    """

    corners: int = 0
    matches: int = 0
    lifted: int = 0
    inliers: int = 0
    inlier_ratio: float = float("nan")
    coverage: float = 0.0
    correlation: float = float("nan")
    reprojection_error_px: float = float("nan")
    deviation: float = float("nan")
    passes: int = 0
    views: int = 0

    def numbers(self) -> dict[str, int | float]:
        """Return the numbers by name, in the order of the attributes."""
        return asdict(self)

    def texts(self) -> dict[str, str]:
        """Return the numbers as texts, for a diagnostic, a picture or a row of a table."""
        return {name: str(n) if isinstance(n, int) else f"{n:.3f}" for name, n in self.numbers().items()}

    @property
    def counts(self) -> str:
        """How many corners were left after each step, in words."""
        return (
            f"{self.corners} corners in the photo, {self.matches} found in the render, {self.lifted} with depth, "
            f"{self.inliers} inliers"
        )


@dataclass(frozen=True)
class Limits:
    """What the evidence must reach for an answer."""

    min_inliers: int = parameter(
        20, "With fewer tracked corners that agree on a pose there is no answer.", (4, 100000), live=True
    )
    min_inlier_ratio: float = parameter(
        0.94, "With a smaller share of inliers among those corners there is no answer.", (0.0, 1.0), live=True
    )
    min_coverage: float = parameter(
        0.1, "With inliers in a smaller share of the image's 8 x 6 cells there is no answer.", (0.0, 1.0), live=True
    )
    min_correlation: float = parameter(
        0.3,
        "With a smaller correlation of image and render at the estimate there is no answer.",
        (-1.0, 1.0),
        live=True,
    )
    # A mirror image, or a wall seen from behind, can match well; such poses are far from the prior.
    max_deviation: float = parameter(
        8.0, "Farther than this many standard deviations from the prior there is no answer.", (0.1, 1e6), live=True
    )


def verdict(evidence: Evidence, limits: Limits) -> tuple[str, ...]:
    """Return the reasons against an estimate, the weightiest first; none: it is an answer."""
    if evidence.inliers == 0:
        return (f"photo and render at the estimate have nothing in common: {evidence.counts}",)
    reasons = []
    if evidence.inliers < limits.min_inliers:
        reasons.append(f"{evidence.counts} (at least {limits.min_inliers} needed)")
    if evidence.inlier_ratio < limits.min_inlier_ratio:
        reasons.append(
            f"{evidence.counts}: a share of {evidence.inlier_ratio:.2f} (at least {limits.min_inlier_ratio:g} needed)"
        )
    if evidence.coverage < limits.min_coverage:
        reasons.append(f"inliers in {evidence.coverage:.0%} of the photo (at least {limits.min_coverage:.0%} needed)")
    # Written so that NaN is a reason.
    if not evidence.correlation >= limits.min_correlation:
        reasons.append(f"correlation {evidence.correlation:.2f} (at least {limits.min_correlation:g} needed)")
    if evidence.deviation > limits.max_deviation:
        reasons.append(
            f"the pose is {evidence.deviation:.1f} standard deviations from the prior "
            f"(at most {limits.max_deviation:g})"
        )
    return tuple(reasons)


def coverage(pixels: np.ndarray, width: int, height: int) -> float:
    """Return the share of the cells of an image, in a grid of 8 x 6, in which at least one of `pixels` (M, 2) lies."""
    across, down = _COVERAGE_CELLS
    columns = np.clip((pixels[:, 0] + 0.5) * across // width, 0, across - 1).astype(int)
    rows = np.clip((pixels[:, 1] + 0.5) * down // height, 0, down - 1).astype(int)
    return len(np.unique(rows * across + columns)) / (across * down)


def inlier_ratio(errors: np.ndarray, max_error: float) -> float:
    """Return the share of tracked corners that agree with a pose, by their reprojection errors (M,) in pixels, M > 0.

    In a blurred photo all of them are less certain: they may be off by four times the median, up to twice `max_error`.
    """
    tolerance = np.clip(_BLUR_TOLERANCE_MEDIANS * np.median(errors), max_error, _MAX_BLUR_TOLERANCE * max_error)
    return float(np.mean(errors <= tolerance))


def deviation(pose: np.ndarray, prior: np.ndarray, covariance: np.ndarray, default_covariance: np.ndarray) -> float:
    """Return the Mahalanobis distance of a pose (4, 4) from a prior (4, 4).

    Args:
        pose, prior: T_map_camera.
        covariance: (6, 6) of the prior. A hundredth of the default covariance is added.
        default_covariance: (6, 6) diagonal, of a prior that comes without one.
    """
    step = np.concatenate([pose[:3, 3] - prior[:3, 3], so3_log(pose[:3, :3] @ prior[:3, :3].T)])
    # In units of the default deviations; what is no covariance (correlations beyond 1) opens no gate.
    unit = np.sqrt(default_covariance.diagonal())
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T) / np.outer(unit, unit))
    variances = np.clip(values, 0.0, None) + _MIN_VARIANCE_SHARE
    return float(np.linalg.norm(vectors.T @ (step / unit) / np.sqrt(variances)))


def correlation(photo: Photo, render: Render) -> float:
    """Return the correlation, in [-1, 1], of a photo with the map's render at the estimate.

    Both are reduced to their local structure, so that exposure, shading and colour balance do not count. NaN where too
    little of the photo has structure that the map covers.

    Args:
        photo: without distortion.
        render: of the same size, drawn with the same K at the estimate.
    """
    camera = photo.camera
    size = (_COMPARED_WIDTH, max(1, round(_COMPARED_WIDTH * camera.height / camera.width)))
    covered = photo.seen & (to_host(render.alpha) >= _MIN_ALPHA)
    covered = cv2.resize(covered.astype(np.float32), size, interpolation=cv2.INTER_AREA) > _MIN_COVERED
    (photo_structure, photo_contrast), (map_structure, map_contrast) = (
        local_structure(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), _NEIGHBOURHOOD, _MIN_CONTRAST)
        for gray in (photo.gray(), cv2.cvtColor(render.image(), cv2.COLOR_RGB2GRAY))
    )
    compared = covered & (np.maximum(photo_contrast, map_contrast) >= _MIN_CONTRAST)
    if compared.mean() < _MIN_COMPARED_SHARE:
        return float("nan")
    a, b = photo_structure[compared], map_structure[compared]
    norm = np.sqrt((a**2).sum() * (b**2).sum())
    return float((a * b).sum() / norm) if norm > 0 else float("nan")
