"""Figures that GSFeatLoc published, to stand beside what is measured here.

Jongwon Lee and Timothy Bretl: GSFeatLoc: Visual Localization Using Feature Correspondence on 3D Gaussian Splatting,
arXiv 2504.20379, 2025. The figures are those of the authors' repository, github.com/jongwonjlee/gsfeatloc, README.md of
30 April 2025 (commit 23db28e), section "Comparison under randomized initial poses": means over all scenes of a data
set. Figures of single scenes could not be checked against a source and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

SOURCE = (
    "J. Lee, T. Bretl: GSFeatLoc: Visual Localization Using Feature Correspondence on 3D Gaussian Splatting, "
    "arXiv 2504.20379 (2025); figures as in the README of github.com/jongwonjlee/gsfeatloc at commit 23db28e, "
    "“Comparison under randomized initial poses”"
)


@dataclass(frozen=True)
class PublishedFigures:
    """Published figures of a method: rotation error in degrees, translation error over the scene's scale."""

    method: str
    mean_rotation_error_deg: float
    mean_translation_error: float
    success_rate: float
    milliseconds: float


@dataclass(frozen=True)
class PublishedTable:
    """Published figures of a data set, over all its scenes."""

    dataset: str
    images: int
    scenes: tuple[str, ...]
    rows: tuple[PublishedFigures, ...]


TABLES = (
    PublishedTable(
        "Synthetic NeRF",
        1600,
        ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
        (
            PublishedFigures("piNeRF", 3.08, 0.05, 0.7188, 13560),
            PublishedFigures("iComMa", 13.29, 0.20, 0.7900, 16740),
            PublishedFigures("GSFeatLoc, SuperPoint and SuperGlue", 1.61, 0.03, 0.9094, 90),
        ),
    ),
    PublishedTable(
        "Mip-NeRF360",
        221,
        ("bicycle", "bonsai", "counter", "flowers", "garden", "kitchen", "room", "stump", "treehill"),
        (
            PublishedFigures("piNeRF", 14.36, 0.25, 0.0122, 13460),
            PublishedFigures("iComMa", 2.67, 0.04, 0.8699, 27780),
            PublishedFigures("GSFeatLoc, SuperPoint and SuperGlue", 1.63, 0.04, 0.9065, 150),
        ),
    ),
    PublishedTable(
        "Tanks and Temples",
        943,
        (
            *(
                "auditorium",
                "ballroom",
                "barn",
                "caterpillar",
                "church",
                "courthouse",
                "courtroom",
                "family",
                "francis",
            ),
            *("horse", "ignatius", "lighthouse", "m60", "meetingroom", "museum", "palace", "panther", "playground"),
            *("temple", "train", "truck"),
        ),
        (
            PublishedFigures("piNeRF", 21.27, 0.27, 0.0689, 14590),
            PublishedFigures("iComMa", 31.71, 0.38, 0.3245, 41790),
            PublishedFigures("GSFeatLoc, SuperPoint and SuperGlue", 11.10, 0.20, 0.4242, 100),
        ),
    ),
)


def published_table(scene: str) -> PublishedTable | None:
    """Return what was published of the data set that a scene, by its name, is of; None if it is of none."""
    return next((table for table in TABLES if scene.lower() in table.scenes), None)
