"""Feature matchers, chosen by name."""

from __future__ import annotations

from collections.abc import Callable

from gsfeatloc_ros.match.base import Features, Matcher, Matches
from gsfeatloc_ros.match.weights import WeightsError

__all__ = ["DEFAULT_MAX_FEATURES", "MATCHERS", "Features", "Matcher", "Matches", "WeightsError", "create_matcher"]

DEFAULT_MAX_FEATURES = 2048


# Each factory imports its own libraries, so that one matcher does not need another's.
def _sift(weights: str, max_features: int) -> Matcher:
    from gsfeatloc_ros.match.sift import Sift

    return Sift(max_features)


def _xfeat(weights: str, max_features: int) -> Matcher:
    from gsfeatloc_ros.match.xfeat import XFeatMatcher

    return XFeatMatcher(weights, max_features)


MATCHERS: dict[str, Callable[[str, int], Matcher]] = {"sift": _sift, "xfeat": _xfeat}


def create_matcher(name: str, weights: str = "", max_features: int = DEFAULT_MAX_FEATURES) -> Matcher:
    """Make a matcher by its name.

    Args:
        name: one of MATCHERS.
        weights: path of the weights of a learned matcher; "" for the usual places (match/weights.py).
        max_features: most features taken from an image.

    Raises:
        ValueError: an unknown name.
        WeightsError: the weights cannot be had.
    """
    if name not in MATCHERS:
        raise ValueError(f"matcher {name!r} is not one of {', '.join(MATCHERS)}")
    return MATCHERS[name](weights, max_features)
