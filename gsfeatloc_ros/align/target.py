"""Targets of known size in photos: AprilTags and checkerboards, and where their corners are seen."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera

# OpenCV's names of the dictionaries.
FAMILIES = {
    "16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "36h11": cv2.aruco.DICT_APRILTAG_36h11,
}
_BOARD = -1
_BOARD_FLAGS = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY


@dataclass(frozen=True, eq=False)
class View:
    """A photo whose pose is known.

    Attributes:
        image: (H, W, 3) uint8 RGB, as observed.
        camera: that took it.
        T_map_camera: (4, 4).
    """

    image: np.ndarray
    camera: Camera
    T_map_camera: np.ndarray


@dataclass(frozen=True, eq=False)
class Sighting:
    """A target in a photo.

    Attributes:
        number: of the tag; a board has none.
        pixels: (K, 2) of its corners, undistorted.
        view: the photo.
    """

    number: int
    pixels: np.ndarray
    view: View


class Tags:
    """AprilTags of one family and one size: the side of the black square, in metres.

    The axes of a tag are OpenCV's: the origin is its middle, x right, y up, z towards who looks at it.
    """

    def __init__(self, family: str, size: float, number: int | None = None) -> None:
        self._number = number
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(FAMILIES[family]), parameters)
        half = 0.5 * size
        self.corners = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
        self.turns = (np.arange(4),)

    def find(self, view: View) -> list[Sighting]:
        """Return the tags in a photo."""
        corners, numbers, _ = self._detector.detectMarkers(cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY))
        if numbers is None:
            return []
        return [
            Sighting(int(number), view.camera.undistort(pixels.reshape(4, 2)), view)
            for number, pixels in zip(np.ravel(numbers).tolist(), corners, strict=True)
            if self._number in (None, number)
        ]


class Checkerboard:
    """A checkerboard by the numbers of its inner corners and the side of a square, in metres."""

    def __init__(self, columns: int, rows: int, size: float) -> None:
        self._size = (columns, rows)
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        self.corners = size * np.column_stack([x.ravel(), -y.ravel(), np.zeros(x.size)]).astype(np.float64)
        # Half a turn may look the same.
        self.turns = (np.arange(x.size), np.arange(x.size)[::-1])

    def find(self, view: View) -> list[Sighting]:
        """Return the board in a photo, if it is whole."""
        gray = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY)
        found, corners = cv2.findChessboardCornersSB(gray, self._size, flags=_BOARD_FLAGS)
        return [Sighting(_BOARD, view.camera.undistort(corners.reshape(-1, 2)), view)] if found else []


Target = Tags | Checkerboard
