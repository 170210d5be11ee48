"""Pinhole camera with lens distortion.

Pixels follow OpenCV and sensor_msgs/CameraInfo: the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import cv2
import numpy as np

from gsfeatloc_ros.common.shrink import shrunk

# OpenCV's models behind the names that sensor_msgs/CameraInfo gives them, with the numbers of coefficients they take.
_COEFFICIENTS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8, 12, 14), "equidistant": (0, 4)}


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of a camera, and how it moved while it took the photo.

    Attributes:
        width, height: image size in pixels.
        K: (3, 3) float64 intrinsic matrix in pixels; its skew K[0, 1] counts as part of the distortion.
        distortion: (n,) float64 coefficients in OpenCV's order for `model`; empty or all zero means none (for the
            equidistant model: an ideal fisheye).
        model: "plumb_bob", "rational_polynomial" or "equidistant" (fisheye), as in sensor_msgs/CameraInfo.
        readout: (6,) how a camera with a rolling shutter moved, evenly, from its first row to its last: translation in
            map units and rotation vector in radians, in its own axes at the middle row; None where that is not known,
            or its shutter is a global one.

    Raises:
        ValueError: a size or focal length that is not positive, a value that is not finite, a K that is not
            upper triangular, an unknown model or a wrong number of coefficients for it.
    """

    width: int
    height: int
    K: np.ndarray
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    model: str = "plumb_bob"
    readout: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.asarray(self.K, dtype=np.float64).reshape(3, 3))
        object.__setattr__(self, "distortion", np.asarray(self.distortion, dtype=np.float64).ravel())
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"camera size {self.width}x{self.height} must be positive")
        if not (np.isfinite(self.K).all() and np.isfinite(self.distortion).all()):
            raise ValueError("camera K and distortion must be finite")
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise ValueError(
                f"focal lengths {self.K[0, 0]:g} and {self.K[1, 1]:g} must be positive: calibrate the camera"
            )
        if not np.array_equal(self.K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
            raise ValueError(f"camera K must be upper triangular and end with 1, got {self.K.tolist()}")
        if self.model not in _COEFFICIENTS:
            raise ValueError(f"distortion model {self.model!r} is not one of {', '.join(_COEFFICIENTS)}")
        counts = _COEFFICIENTS[self.model]
        if len(self.distortion) not in counts:
            raise ValueError(f"distortion model {self.model} takes {counts} coefficients, got {len(self.distortion)}")

    @classmethod
    def centred(cls, width: int, height: int, focal_length: float) -> Camera:
        """Return a camera without distortion that looks along the middle of its image; focal length in pixels."""
        K = np.array([[focal_length, 0, (width - 1) / 2], [0, focal_length, (height - 1) / 2], [0, 0, 1]])
        return cls(width, height, K)

    @property
    def fov_x(self) -> float:
        """Horizontal field of view of the undistorted image, in radians."""
        return 2.0 * float(np.arctan(0.5 * self.width / self.K[0, 0]))

    def scaled(self, width: int, height: int) -> Camera:
        """Return the camera of the same image resized to `width` x `height` pixels.

        Resizing keeps the corners of the image, half a pixel outside the centres of the corner pixels.
        """
        scale = np.diag([width / self.width, height / self.height, 1.0])
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
        return replace(self, width=width, height=height, K=np.linalg.inv(half) @ scale @ half @ self.K)

    def limited(self, max_width: int) -> Camera:
        """Return the camera of the image resized, in proportion, to at most `max_width` pixels of width."""
        if self.width <= max_width:
            return self
        return self.scaled(max_width, max(1, round(self.height * max_width / self.width)))

    def limit(self, image: np.ndarray, max_width: int) -> tuple[np.ndarray, Camera]:
        """Resize an image (H, W, C) of this camera to at most `max_width` pixels of width, with its camera."""
        camera = self.limited(max_width)
        return shrunk(image, camera.width, camera.height), camera

    def enlarged(self, focal_length: float, max_side: int) -> Camera:
        """Return the camera of the image enlarged, in proportion, to a focal length, neither side beyond `max_side`."""
        scale = min(focal_length / self.K[0, 0], max_side / max(self.width, self.height))
        return self.scaled(round(scale * self.width), max(1, round(scale * self.height))) if scale > 1 else self

    def zoomed(self, error: float) -> Camera:
        """Return the camera with a focal length that is longer by this share."""
        return replace(self, K=self.K @ np.diag([1 + error, 1 + error, 1.0]))

    @property
    def distorted(self) -> bool:
        """Whether the camera is anything but a pinhole without skew; a fisheye without coefficients is."""
        return self.model == "equidistant" or bool(self.distortion.any()) or self._skew != 0

    def pinhole(self) -> Camera:
        """Return the camera with the same K, but for its skew, that does not distort."""
        return replace(self, K=self._K_pinhole, distortion=np.zeros(0), model="plumb_bob")

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """Move observed pixels (N, 2) to where `pinhole()` would see them: (N, 2) float64."""
        pixels = np.array(pixels, dtype=np.float64).reshape(-1, 2)
        if len(pixels) == 0 or not self.distorted:
            return pixels
        K = self._K_pinhole
        pixels[:, 0] -= self._skew * (pixels[:, 1] - K[1, 2]) / K[1, 1]
        points = pixels.reshape(-1, 1, 2)
        if self.model == "equidistant":
            undistorted = cv2.fisheye.undistortPoints(points, K, self._fisheye_coefficients, P=K)
        else:
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
            undistorted = cv2.undistortImagePoints(points, K, self.distortion, None, criteria)
        return undistorted.reshape(-1, 2)

    def undistort_image(self, image: np.ndarray) -> np.ndarray:
        """Return the image (H, W, C) of `pinhole()`; it is black where the lens saw nothing."""
        if not self.distorted:
            return image
        x, y, _ = self._undistortion
        return cv2.remap(image, x, y, cv2.INTER_LINEAR)

    def seen(self) -> np.ndarray:
        """Return where (H, W) bool the lens saw something of what `pinhole()` sees; not to be written to."""
        return self._undistortion[2] if self.distorted else np.ones((self.height, self.width), bool)

    @property
    def _undistortion(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return _undistortion(self.width, self.height, self.K.tobytes(), self.distortion.tobytes(), self.model)

    @property
    def _skew(self) -> float:
        """How far, in pixels, a ray of slope 1 in y is moved along x."""
        return float(self.K[0, 1])

    @property
    def _K_pinhole(self) -> np.ndarray:
        return self.K * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]

    @property
    def _fisheye_coefficients(self) -> np.ndarray:
        return self.distortion if len(self.distortion) else np.zeros(4)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project camera-frame points (N, 3) with z > 0 to the pixels (N, 2) of `pinhole()`."""
        return points[:, :2] / points[:, 2:] * (self.K[0, 0], self.K[1, 1]) + self.K[:2, 2]

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Return the camera-frame directions (N, 3) with z = 1 through undistorted pixels (N, 2)."""
        rays = np.ones((len(pixels), 3))
        rays[:, :2] = (pixels - self.K[:2, 2]) / (self.K[0, 0], self.K[1, 1])
        return rays


@lru_cache(maxsize=4)
def _undistortion(
    width: int, height: int, K: bytes, distortion: bytes, model: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the maps (H, W, ...) by which cv2.remap undistorts images of a camera, and where (H, W) bool it saw these.

    All images of a stream have the same: they are computed once.
    """
    camera = Camera(width, height, np.frombuffer(K), np.frombuffer(distortion), model)
    pinhole, size = camera._K_pinhole, (width, height)
    # OpenCV knows nothing of a skew: what it does not have to know of is in fixed point, which is faster.
    kind = cv2.CV_16SC2 if camera._skew == 0 else cv2.CV_32FC1
    if model == "equidistant":
        coefficients = camera._fisheye_coefficients
        x, y = cv2.fisheye.initUndistortRectifyMap(pinhole, coefficients, np.eye(3), pinhole, size, kind)
    else:
        x, y = cv2.initUndistortRectifyMap(pinhole, camera.distortion, None, pinhole, size, kind)
    if camera._skew != 0:
        x += (camera._skew / pinhole[1, 1]) * (y - pinhole[1, 2])
    seen = cv2.remap(np.full((height, width), 255, np.uint8), x, y, cv2.INTER_LINEAR) == 255
    seen.flags.writeable = False
    return x, y, seen
