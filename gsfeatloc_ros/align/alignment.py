"""An alignment as the node takes it: the parameters map.* in a YAML file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from gsfeatloc_ros.common.geometry import quaternion_from_matrix
from gsfeatloc_ros.common.parameter import parameters_of, values_of
from gsfeatloc_ros.common.replaced_file import replaced_file
from gsfeatloc_ros.localize.settings import PLACE, MapSettings
from gsfeatloc_ros.maps.similarity import Similarity


@dataclass(frozen=True, eq=False)
class Alignment:
    """What was found.

    Attributes:
        S_robot_map: from the frame in which the map has lain to the robot's.
        complete: whether that frame is the robot's in all: metres, z up.
        report: lines that say how it was found and how well it is determined.
    """

    S_robot_map: Similarity
    complete: bool
    report: Sequence[str]

    def applied_to(self, map_: MapSettings) -> MapSettings:
        """Return where the map lies now; of a map that lay elsewhere by parameters these are taken in.

        Raises:
            ValueError: the parameters cannot be used, or the scale is out of their range; the message says which.
        """
        # What nerfstudio's file says stays a parameter of its own, and comes before.
        moved = self.S_robot_map @ replace(map_, dataparser_transforms="").alignment()
        placed = replace(
            map_,
            aligned=self.complete,
            scale=moved.scale,
            translation=tuple(moved.translation.tolist()),
            rotation=tuple(quaternion_from_matrix(moved.rotation).tolist()),
        )
        # As the node will.
        for parameter in parameters_of(MapSettings, "map."):
            if parameter.name in PLACE:
                parameter.converted(values_of(placed, "map.")[parameter.name])
        return placed


def write_parameters(path: Path, map_: MapSettings, comments: Sequence[str]) -> None:
    """Write a parameter file for the node, with what there is to say above.

    Raises:
        OSError: it cannot be written.
    """
    default = values_of(MapSettings(), "map.")
    tree: dict[str, Any] = {}
    for name, value in values_of(map_, "map.").items():
        # Others only where they are not the default.
        if name in PLACE or value != default[name]:
            tree[name.removeprefix("map.")] = list(value) if isinstance(value, tuple) else value
    content = yaml.safe_dump({"/**": {"ros__parameters": {"map": tree}}}, sort_keys=False, default_flow_style=None)
    with replaced_file(path) as file:
        file.write("".join(f"# {line}".rstrip() + "\n" for line in comments).encode())
        file.write(content.encode())
