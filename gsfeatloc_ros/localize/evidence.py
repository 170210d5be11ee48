"""What speaks for an estimate and what against it: the map's render at the estimate must match the photo."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np

from gsfeatloc_ros.common.doubt import fisher_z, logit
from gsfeatloc_ros.common.parameter import parameter

# Coverage is counted in this many cells across and down the photo.
_COVERAGE_CELLS = (8, 6)


# A right calibration reads as a longer or shorter focal length by at most this share, and the first number of the
# reading's own standard deviations beside: of 430 right photos one is beyond. A wrong one that is off by no more than
# the second of these beside may read as right. One that is known to be right is contradicted by the third alone.
_MAX_FOCAL_ERROR = 0.01
_FOCAL_SIGMAS, _UNSEEN_FOCAL_SIGMAS, _KNOWN_FOCAL_SIGMAS = 1.0, 1.5, 3.0
# Wrong poses that match well are those of mirror images. Where the photo's mirror image suggests nothing, or what is a
# hundred times more likely to be wrong, a pose is a hundred times less likely to be wrong than it was: of the mirrored
# photos that match well the index finds more than that.
_MIRROR_IS_WORSE = 1e-2
_NO_MIRROR = 1e-2
# Of a pose that no prior expects the first share of the risk is taken, or the second where that was seen to.
_UNEXPECTED = 1e-8
_UNEXPECTED_NO_MIRROR = 1e-2
# A wall seen from behind looks as its mirror image does, and from there most of the photo is of nothing in the map. If
# more of its corners than this are beyond the map, and its mirror image was not seen to be none, nothing is risked.
_MAX_BEYOND_MAP = 0.25
# And this share of one that a prior expects if the mirror image suggests what is less likely to be wrong.
_MIRRORED = 1e-4
# What is seen in a picture on a wall or in a mirror, or is one of several, may be somewhere else: at most this share of
# the photo may be covered or changed, less without a prior, and least where the prior says something else.
_MAX_CHANGED = 0.75
_MAX_CHANGED_WITHOUT_PRIOR = 0.4
_MAX_CHANGED_FAR_FROM_PRIOR = 0.15
# Who looks the same way and has been turned by more than this many degrees about the optical axis was no robot: a
# picture of the place, upside down, was held before the camera.
_MAX_ROLL_FAR_FROM_PRIOR = 90.0
# By a wrong calibration a part of the photo fits, and the rest is found beside where it should be: at least this share
# of the corners that are found agree. Some of what covers a photo is found by chance: where much is not as in the map,
# fewer need agree, since it is asked then whether another focal length explains that.
_MIN_INLIER_RATIO, _MIN_INLIER_RATIO_OF_CHANGED = 0.8, 0.65
MUCH_CHANGED = 0.3
"""Where more of the photo than this is not as in the map, it is asked whether something else explains that."""
# The weights of what tells right from wrong answers (docs/trust.md), and what their sum is shifted and scaled by to be
# the logarithm of the odds that the answer is wrong. Shares count by their logit, the correlation by Fisher's z, and
# blur in degrees: in what is blurred there is less to tell right from wrong by.
_WEIGHTS = {"explained_inlier_ratio": -1.58, "correlation": -15.74, "scattered": 1.58, "blur": 2.90}
_OFFSET, _SLOPE = 27.11, 2.93
# How numbers are written as texts, if not with three decimals.
_FORMATS = {"probability_wrong": ".1e", "mirror_probability_wrong": ".1e", "focal_error": ".4f", "focal_sigma": ".4f"}
# No photo is taken to say more.
_LEAST_PROBABILITY = 1e-15


@dataclass(frozen=True)
class Evidence:
    """The numbers behind an estimate. NaN stands for what could not be measured.

    Attributes:
        corners: number of the photo's corners that were looked for in the last render.
        matches: number of those that were found, of those where the render has a depth; of feature matches where no
            pose was found.
        lifted: number of those that have a depth that can be trusted.
        inliers: number of those that agree with the pose; 0 without pose.
        inlier_ratio: share of the lifted ones that agrees, with some allowance for blur.
        render_inlier_ratio: the same of the render's corners that were found in the photo.
        explained_inlier_ratio: the same of both in the cells of the photo that look as in the map, half a corner of
            each kind added: of few corners less is known.
        coverage: share of the photo's cells, in a grid of 8 x 6, that hold an inlier.
        correlation: mean correlation, in [-1, 1], of photo and render in the cells whose corners agree, without the
            wider parts of the photo that are not as in the map.
        scattered: share of the photo beside these parts in which it shows something else than the map, half a cell of
            each kind added.
        changed: share of the whole photo in which it does.
        beyond_map: share of the photo's corners that are where the map shows nothing.
        reprojection_error_px: RMS of the inliers' reprojection errors in pixels of the localized photo.
        deviation: distance of the pose from the prior in standard deviations of the prior.
        roll_deg: by how many degrees the pose is turned about the optical axis against a prior that looks the same way.
        blur_px: extent of the photo's blur in pixels of the localized photo; 0 for a sharp one.
        bend_px: error in pixels that the covariance allows for, because the corners are off in a smooth pattern that no
            pose and no camera explains, as in a bent map; 0 where they are not.
        focal_error: how much longer than calibrated the focal length fits the photo, relative.
        focal_sigma: standard deviation of that.
        probability_wrong: that the pose is wrong, by all that was looked at.
        mirror_probability_wrong: the same of the pose that the index suggests for the photo's mirror image, 1 where it
            suggests none; NaN where the index was not asked, as it is of a pose that no prior expects and that is not
            certain.
        passes: number of renders at estimates.
        views: number of other views than the prior's that were searched.
        searched: number of the index's views that were compared with the photo.
        index_views: number of views in the index.
    """

    corners: int = 0
    matches: int = 0
    lifted: int = 0
    inliers: int = 0
    inlier_ratio: float = float("nan")
    render_inlier_ratio: float = float("nan")
    explained_inlier_ratio: float = float("nan")
    coverage: float = 0.0
    correlation: float = float("nan")
    scattered: float = float("nan")
    changed: float = float("nan")
    beyond_map: float = float("nan")
    reprojection_error_px: float = float("nan")
    deviation: float = float("nan")
    roll_deg: float = float("nan")
    blur_px: float = float("nan")
    bend_px: float = float("nan")
    focal_error: float = float("nan")
    focal_sigma: float = float("nan")
    probability_wrong: float = float("nan")
    mirror_probability_wrong: float = float("nan")
    passes: int = 0
    views: int = 0
    searched: int = 0
    index_views: int = 0

    def numbers(self) -> dict[str, int | float]:
        """Return the numbers by name, in the order of the attributes."""
        return asdict(self)

    def texts(self) -> dict[str, str]:
        """Return the numbers as texts, for a diagnostic, a picture or a row of a table."""
        return {name: _text(name, number) for name, number in self.numbers().items()}

    @property
    def counts(self) -> str:
        """How many corners were left after each step, in words."""
        return (
            f"{self.corners} corners in the photo, {self.matches} found in the render, {self.lifted} with depth, "
            f"{self.inliers} inliers"
        )


def _text(name: str, number: int | float) -> str:
    if isinstance(number, int):
        return str(number)
    return format(number, _FORMATS.get(name, ".3f"))


@dataclass(frozen=True)
class Limits:
    """What the evidence must reach for an answer."""

    max_risk: float = parameter(
        1e-4, "With a larger probability that the pose is wrong there is no answer.", (1e-9, 1.0), live=True
    )
    min_inliers: int = parameter(
        30, "With fewer tracked corners that agree on a pose there is no answer.", (4, 100000), live=True
    )
    min_coverage: float = parameter(
        0.1, "With inliers in a smaller share of the image's 8 x 6 cells there is no answer.", (0.0, 1.0), live=True
    )
    # A wall seen from behind can match well; such poses are far from the prior. But priors may claim more than they
    # know.
    max_deviation: float = parameter(
        8.0,
        "Farther than this many standard deviations from the prior, or without one, the mirror image must not fit, or "
        "1e-8 of max_risk is taken.",
        (0.1, 1e6),
        live=True,
    )
    max_focal_error: float = parameter(
        0.05,
        "An image in which a focal length that is off by more than this share would not show is no answer: the pose "
        "might be off by as much. 1 where camera_info is known to be right, as a stream's is once ten answers show it.",
        (0.01, 1.0),
        live=True,
    )

    @property
    def focal_length_is_known(self) -> bool:
        """Whether the calibrated focal length is known to be right."""
        return self.max_focal_error >= 1


def verdict(evidence: Evidence, limits: Limits) -> tuple[str, ...]:
    """Return the reasons against an estimate, the weightiest first; none: it is an answer."""
    if evidence.inliers == 0:
        return (f"photo and render at the estimate have nothing in common: {evidence.counts}",)
    reasons = []
    if evidence.deviation > limits.max_deviation and abs(evidence.roll_deg) > _MAX_ROLL_FAR_FROM_PRIOR:
        reasons.append(
            f"it looks the way that the prior does, turned by {abs(evidence.roll_deg):.0f} degrees about the camera's "
            "axis: is the camera mounted so, or does the image show a picture of the place?"
        )
    if focal_length_is_wrong(evidence, limits):
        error, sigma = 100 * evidence.focal_error, 100 * evidence.focal_sigma
        reasons.append(
            f"the focal length fits {abs(error):.1f} +- {sigma:.1f} % {'longer' if error > 0 else 'shorter'} than "
            "calibrated: is camera_info of this stream?"
        )
    elif camera_is_in_doubt(evidence, limits):
        reasons.append(
            f"a focal length that is {unseen_focal_error(evidence):.1%} off would not show in this image (at most "
            f"{limits.max_focal_error:.1%}, localizer.max_focal_error): it shows too flat or too small a part of the "
            "map"
        )
    if evidence.inliers < limits.min_inliers:
        reasons.append(f"{evidence.counts} (at least {limits.min_inliers} needed)")
    # Written so that NaN is a reason.
    max_risk = limits.max_risk * _share_of_risk(evidence, limits)
    if not evidence.probability_wrong <= max_risk:
        why = _why_so_little_risk(evidence, limits)
        reasons.append(
            f"it is wrong with a probability of {evidence.probability_wrong:.1g} (at most {max_risk:g}{why}): "
            f"{evidence.inlier_ratio:.0%} of the photo's corners and {evidence.render_inlier_ratio:.0%} of the "
            f"render's agree, {evidence.explained_inlier_ratio:.0%} where both look alike, with a correlation of "
            f"{evidence.correlation:.2f}; {evidence.changed:.0%} of the photo is not as in the map; {evidence.counts}"
        )
    ratio = float(np.minimum(evidence.inlier_ratio, evidence.render_inlier_ratio))
    min_ratio = _MIN_INLIER_RATIO_OF_CHANGED if evidence.changed > MUCH_CHANGED else _MIN_INLIER_RATIO
    if not ratio >= min_ratio:
        reasons.append(f"{ratio:.0%} of the corners agree (at least {min_ratio:.0%} needed)")
    max_changed = _max_changed(evidence, limits)
    if not evidence.changed <= max_changed:
        most = f"at most {max_changed:.0%}{_why_unexpected(evidence, limits)}"
        reasons.append(f"{evidence.changed:.0%} of the photo is not as in the map ({most})")
    if evidence.coverage < limits.min_coverage:
        reasons.append(f"inliers in {evidence.coverage:.0%} of the photo (at least {limits.min_coverage:.0%} needed)")
    return tuple(reasons)


def _max_changed(evidence: Evidence, limits: Limits) -> float:
    """Return how much of the photo may be not as in the map, by what the prior says of the pose."""
    if evidence.deviation <= limits.max_deviation:
        return _MAX_CHANGED
    return _MAX_CHANGED_FAR_FROM_PRIOR if evidence.deviation > limits.max_deviation else _MAX_CHANGED_WITHOUT_PRIOR


def _share_of_risk(evidence: Evidence, limits: Limits) -> float:
    """Return how much of the risk is taken with a pose, by the prior and the photo's mirror image."""
    wrong, mirror_wrong = evidence.probability_wrong, evidence.mirror_probability_wrong
    if evidence.deviation <= limits.max_deviation:
        return _MIRRORED if mirror_wrong < wrong else 1.0
    if _is_no_mirror_image(evidence):
        return _UNEXPECTED_NO_MIRROR
    return _UNEXPECTED if evidence.beyond_map <= _MAX_BEYOND_MAP else 0.0


def _is_no_mirror_image(evidence: Evidence) -> bool:
    """Return whether the photo's mirror image was found to be so much worse that the photo is taken for none."""
    return evidence.probability_wrong <= _NO_MIRROR * _MIRROR_IS_WORSE * evidence.mirror_probability_wrong


def _why_so_little_risk(evidence: Evidence, limits: Limits) -> str:
    """Return in words why less risk is taken with a pose; nothing for one with which all is."""
    share = _share_of_risk(evidence, limits)
    if share == 1.0:
        return ""
    if evidence.mirror_probability_wrong < 1 and not _is_no_mirror_image(evidence):
        return ", for the photo's mirror image fits about as well: is the image flipped?"
    if share == 0.0:
        nothing = f", for the map shows nothing of {evidence.beyond_map:.0%} of the photo"
        return nothing + _why_unexpected(evidence, limits)
    return _why_unexpected(evidence, limits)


def _why_unexpected(evidence: Evidence, limits: Limits) -> str:
    """Return in words why no prior expects a pose; nothing for one that is where a prior says."""
    if evidence.deviation <= limits.max_deviation:
        return ""
    if evidence.deviation > limits.max_deviation:
        return f", for the pose is {evidence.deviation:.1f} standard deviations from the prior"
    return " without a prior"


def is_uncertain(evidence: Evidence, limits: Limits) -> bool:
    """Return whether the photo's mirror image, which was not looked for yet, decides on the pose."""
    if not math.isnan(evidence.mirror_probability_wrong):
        return False
    best, worst = (verdict(with_mirror(evidence, wrong), limits) for wrong in (0.0, 1.0))
    return bool(best) and not worst


def with_mirror(evidence: Evidence, mirror_probability_wrong: float) -> Evidence:
    """Return evidence with what the photo's mirror image says, which was not asked yet.

    `mirror_probability_wrong` is the probability that the best pose of the mirror image is wrong, 1 if there is none.
    """
    wrong = evidence.probability_wrong
    if wrong <= _MIRROR_IS_WORSE * mirror_probability_wrong:
        wrong *= _NO_MIRROR
    return replace(evidence, probability_wrong=wrong, mirror_probability_wrong=mirror_probability_wrong)


def focal_length_is_wrong(evidence: Evidence, limits: Limits) -> bool:
    """Return whether the photo contradicts the focal length that was calibrated."""
    most = _MAX_FOCAL_ERROR + _FOCAL_SIGMAS * evidence.focal_sigma
    if limits.focal_length_is_known:
        most = max(most, _KNOWN_FOCAL_SIGMAS * evidence.focal_sigma)
    return abs(evidence.focal_error) > most


def camera_is_in_doubt(evidence: Evidence, limits: Limits) -> bool:
    """Return whether the photo contradicts the calibrated focal length, or could not contradict one that matters."""
    return focal_length_is_wrong(evidence, limits) or unseen_focal_error(evidence) > limits.max_focal_error


def unseen_focal_error(evidence: Evidence) -> float:
    """Return by what share a focal length may be off without being seen to be, NaN where that is not known.

    It is large where a photo shows a plane from the front: nearer, or with a longer lens, that looks the same.
    """
    return _MAX_FOCAL_ERROR + _UNSEEN_FOCAL_SIGMAS * evidence.focal_sigma


def probability_wrong(evidence: Evidence, focal_length: float) -> float:
    """Return the probability that a pose with this evidence is wrong, NaN where that cannot be said.

    The focal length, in pixels, is that of the localized photo.

    A logistic regression on right answers (also of photos that are badly lit, blurred or covered) and on wrong poses
    that matched well (mirror images of a nearly symmetric object); see docs/trust.md for how far it can be trusted.
    """
    agreeing, scattered = logit(np.array([evidence.explained_inlier_ratio, evidence.scattered]))
    blur_deg = np.degrees(evidence.blur_px / focal_length)
    values = np.array([agreeing, fisher_z(evidence.correlation), scattered, blur_deg])
    log_odds = _SLOPE * (_OFFSET + values @ list(_WEIGHTS.values()))
    return float(np.maximum(1 / (1 + np.exp(-log_odds)), _LEAST_PROBABILITY))


def coverage(pixels: np.ndarray, width: int, height: int) -> float:
    """Return the share of the cells of an image, in a grid of 8 x 6, in which at least one of `pixels` (M, 2) lies."""
    across, down = _COVERAGE_CELLS
    columns = np.clip((pixels[:, 0] + 0.5) * across // width, 0, across - 1).astype(int)
    rows = np.clip((pixels[:, 1] + 0.5) * down // height, 0, down - 1).astype(int)
    return len(np.unique(rows * across + columns)) / (across * down)
