"""An index of views of the map: where a photo without any prior may have been taken."""

from gsfeatloc_ros.index.build import build_index
from gsfeatloc_ros.index.options import IndexOptions
from gsfeatloc_ros.index.view_index import Nearest, ViewIndex

__all__ = ["IndexOptions", "Nearest", "ViewIndex", "build_index"]
