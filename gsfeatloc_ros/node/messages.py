"""ROS messages in and out of the localizer's own types, checked at the door.

Everything that comes from outside is checked here and nowhere else: a message that cannot be used raises ValueError,
which says what is wrong and what to do about it. Nothing here needs a running node.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import cv2
import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.estimate import Estimate
from gsfeatloc_ros.geometry import make_pose, matrix_from_quaternion, quaternion_from_matrix

# No camera is larger; a message that says so is corrupt.
MAX_SIDE = 16384


@dataclass(frozen=True)
class _Encoding:
    """How the pixels of an image encoding lie in memory.

    Attributes:
        channels: samples per pixel as stored (YUV 4:2:2 stores two).
        bits: 8 or 16 bits per sample.
        conversion: cv2.cvtColor code that makes it RGB; None where it is RGB.
        multiple: width and height must be multiples of these.
        smallest: least width and height that can be converted.
    """

    channels: int
    bits: int
    conversion: int | None
    multiple: tuple[int, int] = (1, 1)
    smallest: tuple[int, int] = (1, 1)


def _bayer(bits: int, conversion: int) -> _Encoding:
    # Bilinear interpolation in OpenCV leaves images of less than 3x3 pixels black.
    return _Encoding(1, bits, conversion, smallest=(3, 3))


def _yuv422(conversion: int) -> _Encoding:
    return _Encoding(2, 8, conversion, multiple=(2, 1), smallest=(2, 1))


# The names of sensor_msgs/image_encodings.hpp. Of OpenCV's names for Bayer patterns only the four-letter ones mean the
# same as in ROS.
ENCODINGS = {
    "rgb8": _Encoding(3, 8, None),
    "bgr8": _Encoding(3, 8, cv2.COLOR_BGR2RGB),
    "rgba8": _Encoding(4, 8, cv2.COLOR_RGBA2RGB),
    "bgra8": _Encoding(4, 8, cv2.COLOR_BGRA2RGB),
    "mono8": _Encoding(1, 8, cv2.COLOR_GRAY2RGB),
    "mono16": _Encoding(1, 16, cv2.COLOR_GRAY2RGB),
    "bayer_rggb8": _bayer(8, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": _bayer(8, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": _bayer(8, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": _bayer(8, cv2.COLOR_BayerGRBG2RGB),
    "bayer_rggb16": _bayer(16, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr16": _bayer(16, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg16": _bayer(16, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg16": _bayer(16, cv2.COLOR_BayerGRBG2RGB),
    "yuv422": _yuv422(cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": _yuv422(cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": _yuv422(cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": _yuv422(cv2.COLOR_YUV2RGB_YUY2),
}


def validate_image(message: Image) -> None:
    """Check, without touching the pixels, that an image can be decoded.

    Raises:
        ValueError: unknown encoding, a size that no camera has, or data and step that do not hold the pixels.
    """
    encoding = ENCODINGS.get(message.encoding)
    if encoding is None:
        raise ValueError(f"image encoding {message.encoding!r} is not supported: publish one of {', '.join(ENCODINGS)}")
    width, height = message.width, message.height
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise ValueError(f"image size {width}x{height} must be 1 to {MAX_SIDE} pixels a side: check the camera driver")
    if width < encoding.smallest[0] or height < encoding.smallest[1]:
        raise ValueError(f"image size {width}x{height} is too small for {message.encoding}")
    if width % encoding.multiple[0] or height % encoding.multiple[1]:
        raise ValueError(f"image width {width} must be even for {message.encoding}: check the camera driver")
    row_bytes = width * encoding.channels * encoding.bits // 8
    if message.step < row_bytes:
        raise ValueError(
            f"image step {message.step} is less than the {row_bytes} bytes of a row of {width} {message.encoding} "
            "pixels: check the camera driver"
        )
    if len(message.data) < message.step * height:
        raise ValueError(
            f"image data has {len(message.data)} bytes but step {message.step} x height {height} needs "
            f"{message.step * height}: the image was cut short, check the camera driver"
        )


def decode_image(message: Image) -> np.ndarray:
    """Pixels (H, W, 3) uint8 RGB of an image of any of the ENCODINGS; an alpha channel is dropped.

    16-bit samples are taken over their full range, as in cv_bridge: 65535 becomes 255.

    Raises:
        ValueError: see validate_image.
    """
    validate_image(message)
    encoding = ENCODINGS[message.encoding]
    rows = np.frombuffer(message.data, np.uint8, count=message.step * message.height)
    rows = rows.reshape(message.height, message.step)[:, : message.width * encoding.channels * encoding.bits // 8]
    pixels = np.ascontiguousarray(rows)
    if encoding.bits == 16:
        samples = pixels.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
        pixels = cv2.convertScaleAbs(samples, alpha=255.0 / 65535.0)
    if encoding.channels > 1:
        pixels = pixels.reshape(message.height, message.width, encoding.channels)
    return pixels if encoding.conversion is None else cv2.cvtColor(pixels, encoding.conversion)


def image_message(rgb: np.ndarray, header: Header) -> Image:
    """Image message of encoding rgb8 from pixels (H, W, 3) uint8 RGB."""
    height, width = rgb.shape[:2]
    # The one way to fill Image.data without a slow check of every byte (measured: 0.4 ms for 1080p, a list 150 ms).
    data = array("B")
    data.frombytes(np.ascontiguousarray(rgb).data.cast("B"))
    return Image(header=header, height=height, width=width, encoding="rgb8", step=3 * width, data=data)


def decode_camera(message: CameraInfo) -> Camera:
    """Camera of a CameraInfo: its K, D and distortion model, for the raw image (not the rectified one).

    Raises:
        ValueError: an uncalibrated camera (K of zeros), or values that no camera has.
    """
    if not np.any(message.k):
        raise ValueError(
            "camera_info has a K of zeros, the camera is not calibrated: calibrate it (camera_calibration) and have "
            "the driver load the result (camera_info_url)"
        )
    try:
        # Drivers leave the name of the model empty when there is no distortion.
        return Camera(message.width, message.height, message.k, message.d, message.distortion_model or "plumb_bob")
    except ValueError as error:
        raise ValueError(f"camera_info cannot be used: {error}") from error


def decode_prior(message: PoseStamped, map_frame: str) -> np.ndarray:
    """Pose T_map_camera (4, 4) of a PoseStamped that gives the camera's optical frame in the frame `map_frame`.

    A quaternion that is not of unit length is normalised.

    Raises:
        ValueError: another frame, a value that is not finite, or a quaternion of zeros.
    """
    if message.header.frame_id != map_frame:
        raise ValueError(
            f"prior is in frame {message.header.frame_id!r} but the map is in {map_frame!r}: transform it, or set "
            "map.frame_id"
        )
    position, orientation = message.pose.position, message.pose.orientation
    translation = np.array([position.x, position.y, position.z])
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    if not (np.isfinite(translation).all() and np.isfinite(quaternion).all()):
        raise ValueError(
            f"prior has position {translation.tolist()} and quaternion {quaternion.tolist()}: all must be finite"
        )
    try:
        return make_pose(matrix_from_quaternion(quaternion), translation)
    except ValueError as error:
        raise ValueError(f"prior cannot be used: {error}") from error


def pose_message(estimate: Estimate, header: Header) -> PoseWithCovarianceStamped:
    """Pose message of an estimate that was localized."""
    message = PoseWithCovarianceStamped(header=header)
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z = estimate.T_map_camera[:3, 3].tolist()
    quaternion = quaternion_from_matrix(estimate.T_map_camera[:3, :3])
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion.tolist()
    message.pose.covariance = estimate.covariance.ravel().tolist()
    return message
