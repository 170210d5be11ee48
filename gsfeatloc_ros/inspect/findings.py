"""What looks wrong with a map for localization: each rule has a threshold, a reason, and is the same for all maps."""

from __future__ import annotations

from collections.abc import Iterator

from gsfeatloc_ros.inspect.floaters import Floaters
from gsfeatloc_ros.inspect.quality import Quality
from gsfeatloc_ros.inspect.statistics import Statistics
from gsfeatloc_ros.inspect.unit import Unit
from gsfeatloc_ros.inspect.upright import Upright

# The maps of 68,000 that docs/evaluation.md measures are small; of a room, fewer than these are a blur.
_MIN_GAUSSIANS = 10_000
# In the maps measured it is at most 0.006, of leaves and chairs; evaluate --degrade floaters hangs 0.04 of them.
_MAX_FLOATERS = 0.01
# An index keeps up to 225 features of a view; an answer needs 30 inliers, and half of the features are lost.
_MIN_CORNERS = 100
# Matches that cannot be lifted are lost.
_MIN_LIFTED = 0.5
# What is seen through holes is the background. In the maps measured it is up to 0.11.
_MAX_THIN = 0.2
# Degrees to which a frame counts as upright; ROS has z up (REP 103).
_MAX_TILT_DEG = 2.0


def find_problems(
    statistics: Statistics, quality: Quality, floaters: Floaters, upright: Upright | None, unit: Unit | None
) -> list[str]:
    """Return what looks wrong, in whole sentences."""
    return [*_of_gaussians(statistics, quality, floaters), *_of_frame(upright, unit)]


def _of_gaussians(statistics: Statistics, quality: Quality, floaters: Floaters) -> Iterator[str]:
    if statistics.count < _MIN_GAUSSIANS:
        yield (
            f"It has {statistics.count:,} Gaussians, fewer than {_MIN_GAUSSIANS:,}: enough for one thing, too few for "
            "a room. Train it longer, or on larger photos."
        )
    if floaters.share > _MAX_FLOATERS:
        yield (
            f"{floaters.count:,} Gaussians ({floaters.share:.1%}, more than {_MAX_FLOATERS:.1%}) hang in free space: "
            "they hide what photos show. Crop them (SuperSplat), or train with more photos there."
        )
    if quality.views == 0:
        yield "No place was found from which it shows a surface: nothing can be localized in it."
        return
    if quality.corners < _MIN_CORNERS:
        yield (
            f"Its views have {quality.corners:.0f} features (median), fewer than {_MIN_CORNERS}: blank or blurred, and "
            "photos of it may not be recognized."
        )
    if quality.lifted < _MIN_LIFTED:
        yield (
            f"The depth of {quality.lifted:.0%} of what its views show can be trusted, of less than "
            f"{_MIN_LIFTED:.0%}: layers before each other, or edges everywhere. Matches elsewhere are lost."
        )
    if quality.thin > _MAX_THIN:
        yield (
            f"{quality.thin:.0%} of what its views show is covered less than a half, more than {_MAX_THIN:.0%}: it has "
            "holes, or was pruned too far."
        )


def _of_frame(upright: Upright | None, unit: Unit | None) -> Iterator[str]:
    if upright is None or not upright.sure:
        yield "Which way is up cannot be told from it: say so by map.rotation, if it is not z."
    elif upright.tilt_deg > _MAX_TILT_DEG:
        yield (
            f"Up is {upright.tilt_deg:.0f} degrees from the map frame's z, more than {_MAX_TILT_DEG:g}: set "
            "map.rotation, as below, if a robot with z up is to use it."
        )
    if unit is not None and not unit.may_be_metre:
        yield (
            f"A unit is likely to be {unit.likely:.3g} m ({unit.low:.2g} to {unit.high:.2g}), as {unit.by}: set "
            "map.scale once it is measured."
        )
