"""Settings of a view index."""

from __future__ import annotations

from dataclasses import dataclass

from gsfeatloc_ros.common.parameter import parameter


@dataclass(frozen=True)
class IndexOptions:
    """Settings of a view index; the node has them as parameters `index.*`."""

    build: bool = parameter(True, "Make the index of views, which finds images without a prior, where there is none.")
    path: str = parameter(
        "",
        "Path of the index of views; empty for a file beside the map (*.gsfeatloc-index) or in the user's cache.",
    )
    views: int = parameter(480, "Number of views in an index that is made.", (1, 100_000))
    seed: int = parameter(0, "Seed of the places of the views.", (0, 2**31 - 1))
    camera_height: float = parameter(
        0.0,
        "Height in metres, above the map's plane z = 0, of the camera of a robot that stays on it: views are placed "
        "there. 0 for anywhere. Needs map.aligned.",
        (0.0, 1000.0),
    )
    camera_pitch: float = parameter(0.0, "By how many degrees that camera looks up, or, negative, down.", (-90.0, 90.0))

    @property
    def on_plane(self) -> bool:
        """Whether views are placed where the camera of a robot on the plane z = 0 is."""
        return self.camera_height > 0
