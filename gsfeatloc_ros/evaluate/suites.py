"""What photos, priors and maps are put through: one condition a run, and suites of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from gsfeatloc_ros.evaluate.corruptions import CORRUPTIONS, MISCALIBRATIONS
from gsfeatloc_ros.evaluate.degradations import DEGRADATIONS
from gsfeatloc_ros.evaluate.negatives import NEGATIVES

OTHER_SCENES = "other-scenes"
"""The negatives that are the photos of all the other scenes that are evaluated."""


@dataclass(frozen=True)
class Condition:
    """What is done to the photos, the priors or the map of a scene.

    Attributes:
        protocol: how priors are made wrong, as in Run.
        corruption, degradation: as in Run.
        negative: as in Run, or OTHER_SCENES; corrupted as well where both are named.
    """

    protocol: str = "paper"
    corruption: str = ""
    degradation: str = ""
    negative: str = ""

    def negatives(self, scene: Path, scenes: Sequence[Path]) -> list[str]:
        """Return the values of Run.negative that this stands for in a scene, one of `scenes`."""
        if self.negative != OTHER_SCENES:
            return [self.negative]
        return [str(other) for other in scenes if other != scene]


# What makes the mirror image of a nearly symmetric thing look more like the thing: detail is lost, or little is left.
_DONE_TO_MIRRORED = ("motion-25", "defocus", "cover-40", "blobs", "small-160", "small-80", "crop")

SUITES: dict[str, tuple[Condition, ...]] = {
    "trust": (
        Condition(),
        Condition(protocol="near-miss"),
        *(Condition(corruption=name) for name in CORRUPTIONS),
        *(Condition(degradation=name) for name in DEGRADATIONS),
        *(Condition(negative=name) for name in (*NEGATIVES, OTHER_SCENES)),
        *(Condition(negative="mirrored", corruption=name) for name in _DONE_TO_MIRRORED),
    )
}
"""By name: whether answers can be trusted."""


class Kind(Enum):
    """Kinds of conditions: the parts of a table, in their order."""

    RIGHT = "right photos"
    CORRUPTED = "corrupted photos"
    MISCALIBRATED = "wrong calibrations"
    DEGRADED = "degraded maps"
    NEGATIVE = "photos that are not of the scene"


def kind_of(corruption: str, degradation: str, negative: str) -> Kind:
    """Return the kind of a condition, given what it has of these; the weightiest counts."""
    if negative:
        return Kind.NEGATIVE
    if degradation:
        return Kind.DEGRADED
    if corruption in MISCALIBRATIONS:
        return Kind.MISCALIBRATED
    return Kind.CORRUPTED if corruption else Kind.RIGHT
