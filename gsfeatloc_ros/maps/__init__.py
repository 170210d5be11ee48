"""Map files and the Gaussians in them."""

from __future__ import annotations

from pathlib import Path

from gsfeatloc_ros.maps.gaussian_map import GaussianMap, MapError
from gsfeatloc_ros.maps.ply import read_ply

__all__ = ["GaussianMap", "MapError", "load_map"]


def load_map(path: str | Path) -> GaussianMap:
    """Read a 3D Gaussian Splatting map from a file.

    Args:
        path: a .ply in the layout of the INRIA trainer, gsplat and nerfstudio.

    Raises:
        MapError: the file cannot be used; the message names it, what is wrong and what to do.
    """
    return read_ply(Path(path))
