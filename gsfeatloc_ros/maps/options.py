"""What a map's file may leave open, for its reader."""

from __future__ import annotations

from dataclasses import dataclass

from gsfeatloc_ros.common.parameter import parameter


@dataclass(frozen=True)
class ReadOptions:
    """How a map's file is to be read where it does not say, or says it wrong."""

    antialiased: str = parameter(
        "auto",
        "Whether the map was trained antialiased (Mip-Splatting, mode antialiased of nerfstudio and gsplat): true, "
        "false, or auto: as the file says, and not where it says nothing.",
        choices=("auto", "true", "false"),
    )
    spz_axes: str = parameter(
        "auto",
        "Axes of an .spz: ply for those of the .ply that it was made from, rub for right, up, back, or auto: as the "
        "file says, and rub where it says nothing.",
        choices=("auto", "ply", "rub"),
    )
    level: int = parameter(0, "Level of detail that is read of a streamed .sog; 0 is the finest.", (0, 64))
