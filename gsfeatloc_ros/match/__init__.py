"""Feature matchers, chosen by name."""

from __future__ import annotations

from collections.abc import Callable

from gsfeatloc_ros.match.base import Features, Matcher, Matches
from gsfeatloc_ros.match.weights import WeightsError

__all__ = [
    "DEFAULT_MATCHER",
    "DEFAULT_MAX_FEATURES",
    "MATCHERS",
    "Features",
    "Matcher",
    "Matches",
    "WeightsError",
    "create_matcher",
]

# Chosen by measurement (README.md): as accurate and fast as the next, of more use from far priors, and without weights.
DEFAULT_MATCHER = "sift"
DEFAULT_MAX_FEATURES = 2048


# Each factory imports its own libraries, so that one matcher does not need another's.
def _sift(weights: str, max_features: int) -> Matcher:
    from gsfeatloc_ros.match.sift import Sift

    return Sift(max_features)


def _xfeat(weights: str, max_features: int) -> Matcher:
    from gsfeatloc_ros.match.xfeat import XFeatMatcher

    return XFeatMatcher(weights, max_features)


def _xfeat_lighterglue(weights: str, max_features: int) -> Matcher:
    from gsfeatloc_ros.match.lightglue import LightGlueMatcher
    from gsfeatloc_ros.match.xfeat import XFeatMatcher

    return LightGlueMatcher(XFeatMatcher, "xfeat", weights, max_features)


def _aliked_lightglue(weights: str, max_features: int) -> Matcher:
    from gsfeatloc_ros.match.aliked import AlikedExtractor
    from gsfeatloc_ros.match.lightglue import LightGlueMatcher

    return LightGlueMatcher(AlikedExtractor, "aliked", weights, max_features)


def _disk_lightglue(weights: str, max_features: int) -> Matcher:
    from gsfeatloc_ros.match.disk import DiskExtractor
    from gsfeatloc_ros.match.lightglue import LightGlueMatcher

    return LightGlueMatcher(DiskExtractor, "disk", weights, max_features)


def _loftr(weights: str, max_features: int) -> Matcher:
    from gsfeatloc_ros.match.loftr import LoftrMatcher

    return LoftrMatcher(weights, max_features)


# Magic Leap's licence of SuperPoint and SuperGlue allows noncommercial research only: see superpoint.py.
def _superpoint_superglue(weights: str, max_features: int) -> Matcher:
    from gsfeatloc_ros.match.superpoint import SuperPointMatcher

    return SuperPointMatcher("superglue", weights, max_features)


def _superpoint_lightglue(weights: str, max_features: int) -> Matcher:
    from gsfeatloc_ros.match.superpoint import SuperPointMatcher

    return SuperPointMatcher("lightglue", weights, max_features)


MATCHERS: dict[str, Callable[[str, int], Matcher]] = {
    "sift": _sift,
    "xfeat": _xfeat,
    "xfeat-lighterglue": _xfeat_lighterglue,
    "aliked-lightglue": _aliked_lightglue,
    "disk-lightglue": _disk_lightglue,
    "loftr": _loftr,
    "superpoint-superglue": _superpoint_superglue,
    "superpoint-lightglue": _superpoint_lightglue,
}


def create_matcher(name: str, weights: str = "", max_features: int = DEFAULT_MAX_FEATURES) -> Matcher:
    """Make a matcher by its name.

    Args:
        name: one of MATCHERS.
        weights: path of the weights of a learned matcher, of one with two networks the folder of both files (named as
            in torch hub's cache), or the name of a model on Hugging Face's hub; "" for the usual places.
        max_features: most features taken from an image.

    Raises:
        ValueError: an unknown name.
        WeightsError: the weights cannot be had.
    """
    if name not in MATCHERS:
        raise ValueError(f"matcher {name!r} is not one of {', '.join(MATCHERS)}")
    return MATCHERS[name](weights, max_features)
