"""Feature matchers, chosen by name, and trackers of corners."""

from __future__ import annotations

from collections.abc import Callable

from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.match.base import Features, Matcher, Matches, Tracker
from gsfeatloc_ros.match.weights import WeightsError
from gsfeatloc_ros.render import chosen_device

__all__ = [
    "DEFAULT_MATCHER",
    "DEFAULT_MAX_FEATURES",
    "MATCHERS",
    "Features",
    "Matcher",
    "Matches",
    "Tracker",
    "WeightsError",
    "create_matcher",
    "create_tracker",
]

# Chosen by measurement (README.md): as accurate and fast as the next, of more use from far priors, and without weights.
DEFAULT_MATCHER = "sift"
DEFAULT_MAX_FEATURES = 2048


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


# Magic Leap's licence of SuperPoint and SuperGlue allows noncommercial research only: see superpoint.py.
def _superpoint_superglue(weights: str, max_features: int, device: str) -> Matcher:
    from gsfeatloc_ros.match.superpoint import SuperPointMatcher

    return SuperPointMatcher("superglue", weights, max_features, device)


def _superpoint_lightglue(weights: str, max_features: int, device: str) -> Matcher:
    from gsfeatloc_ros.match.superpoint import SuperPointMatcher

    return SuperPointMatcher("lightglue", weights, max_features, device)


MATCHERS: dict[str, Callable[[str, int, str], Matcher]] = {
    "sift": _sift,
    "xfeat": _xfeat,
    "xfeat-lighterglue": _xfeat_lighterglue,
    "aliked-lightglue": _aliked_lightglue,
    "disk-lightglue": _disk_lightglue,
    "loftr": _loftr,
    "superpoint-superglue": _superpoint_superglue,
    "superpoint-lightglue": _superpoint_lightglue,
}


def create_matcher(
    name: str, weights: str = "", max_features: int = DEFAULT_MAX_FEATURES, device: str = "auto"
) -> Matcher:
    """Make a matcher by its name.

    Args:
        name: one of MATCHERS.
        weights: path of the weights of a learned matcher, of one with two networks the folder of both files (named as
            in torch hub's cache), or the name of a model on Hugging Face's hub; "" for the usual places.
        max_features: most features taken from an image.
        device: "cpu", "cuda" or "auto", as in create_renderer: a GPU is used if it can be rendered on too.

    Raises:
        ValueError: an unknown name or device.
        RuntimeError: device "cuda" cannot be used; the message says what is missing and what to do.
        WeightsError: the weights cannot be had.
    """
    if name not in MATCHERS:
        raise ValueError(f"matcher {name!r} is not one of {', '.join(MATCHERS)}")
    return MATCHERS[name](weights, max_features, chosen_device(device))


def create_tracker(photo: Photo, device: str) -> Tracker:
    """Make the tracker of a photo for renders that lie on `device` (Renderer.device)."""
    if device == "cpu":
        from gsfeatloc_ros.match.track import CornerTracker

        return CornerTracker(photo)
    from gsfeatloc_ros.match.track_gpu import GpuCornerTracker

    return GpuCornerTracker(photo, device)
