"""Decode ROS messages into the localizer's own types.

Everything that comes from outside is checked here and nowhere else: a message that cannot be used raises ValueError,
which says what is wrong and what to do about it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion
from gsfeatloc_ros.ros_io.jpeg_png import decode, read_header
from gsfeatloc_ros.ros_io.message_types import (
    AnyImage,
    AnyPose,
    CameraInfo,
    CompressedImage,
    Image,
    Odometry,
    PoseWithCovariance,
    Time,
)

# Pixels. No camera is larger; a message that says so is corrupt.
MAX_SIDE = 16384
# Of a prior, in m^2 or rad^2; a larger one says nothing, and products of it overflow.
_MAX_VARIANCE = 1e12


class PictureError(ValueError):
    """The picture of an image message cannot be used, or is of another size than its camera's."""


@dataclass(frozen=True)
class _Encoding:
    """How the pixels of an image encoding lie in memory.

    Attributes:
        channels: samples per pixel as stored (YUV 4:2:2 stores two), in a row.
        bits: 8 or 16 bits per sample.
        conversion: cv2.cvtColor code that makes it RGB; None where it is RGB.
        multiple: width and height must be multiples of these.
        smallest: least width and height that can be converted.
        planes: rows of data for two rows of pixels; more than two where the chroma lies below the brightness.
    """

    channels: int
    bits: int
    conversion: int | None
    multiple: tuple[int, int] = (1, 1)
    smallest: tuple[int, int] = (1, 1)
    planes: int = 2


def _bayer(bits: int, conversion: int) -> _Encoding:
    # Bilinear interpolation in OpenCV leaves images of less than 3x3 pixels black.
    return _Encoding(1, bits, conversion, smallest=(3, 3))


def _yuv422(conversion: int) -> _Encoding:
    return _Encoding(2, 8, conversion, multiple=(2, 1), smallest=(2, 1))


# The names of sensor_msgs/image_encodings.hpp that are of pictures; those like 8UC3 are in OpenCV's order. Of OpenCV's
# own names for Bayer patterns only the four-letter ones mean the same as in ROS.
ENCODINGS = {
    "rgb8": _Encoding(3, 8, None),
    "bgr8": _Encoding(3, 8, cv2.COLOR_BGR2RGB),
    "rgba8": _Encoding(4, 8, cv2.COLOR_RGBA2RGB),
    "bgra8": _Encoding(4, 8, cv2.COLOR_BGRA2RGB),
    "rgb16": _Encoding(3, 16, None),
    "bgr16": _Encoding(3, 16, cv2.COLOR_BGR2RGB),
    "rgba16": _Encoding(4, 16, cv2.COLOR_RGBA2RGB),
    "bgra16": _Encoding(4, 16, cv2.COLOR_BGRA2RGB),
    "8UC1": _Encoding(1, 8, cv2.COLOR_GRAY2RGB),
    "8UC3": _Encoding(3, 8, cv2.COLOR_BGR2RGB),
    "8UC4": _Encoding(4, 8, cv2.COLOR_BGRA2RGB),
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
    "nv21": _Encoding(1, 8, cv2.COLOR_YUV2RGB_NV21, multiple=(2, 2), smallest=(2, 2), planes=3),
    "nv24": _Encoding(1, 8, cv2.COLOR_YUV2RGB_NV12, multiple=(2, 2), smallest=(2, 2), planes=6),
}


def validate_image(message: Image) -> None:
    """Check that an image can be decoded, without touching the pixels.

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
        raise ValueError(
            f"image size {width}x{height} must be a multiple of {encoding.multiple[0]}x{encoding.multiple[1]} "
            f"for {message.encoding}: check the camera driver"
        )
    row_bytes = width * encoding.channels * encoding.bits // 8
    if message.step < row_bytes:
        raise ValueError(
            f"image step {message.step} is less than the {row_bytes} bytes of a row of {width} {message.encoding} "
            "pixels: check the camera driver"
        )
    needed = message.step * height * encoding.planes // 2
    if len(message.data) < needed:
        raise ValueError(
            f"image data has {len(message.data)} bytes but step {message.step} x height {height} needs "
            f"{needed}{'' if encoding.planes == 2 else ' with the chroma'}: the image was cut short, check the camera "
            "driver"
        )


def decode_image(message: Image) -> np.ndarray:
    """Return the pixels (H, W, 3) uint8 RGB of an image of any of the ENCODINGS; an alpha channel is dropped.

    16-bit samples are taken over their full range, as in cv_bridge: 65535 becomes 255.

    Raises:
        ValueError: see validate_image.
    """
    validate_image(message)
    encoding = ENCODINGS[message.encoding]
    height = message.height * encoding.planes // 2
    rows = np.frombuffer(message.data, np.uint8, count=message.step * height)
    rows = rows.reshape(height, message.step)[:, : message.width * encoding.channels * encoding.bits // 8]
    pixels: np.ndarray = np.ascontiguousarray(rows)
    if message.encoding == "nv24":
        # A chroma of each pixel, in rows of twice the width: OpenCV takes one of four (NV12).
        brightness, chroma = np.split(pixels, [message.height])
        chroma = chroma.reshape(message.height, message.width, 2)[::2, ::2]
        pixels = np.vstack([brightness, chroma.reshape(-1, message.width)])
    if encoding.bits == 16:
        samples = pixels.view(">u2" if message.is_bigendian else "<u2").astype(np.uint16)
        pixels = cv2.convertScaleAbs(samples, alpha=255.0 / 65535.0)
    if encoding.channels > 1:
        pixels = pixels.reshape(message.height, message.width, encoding.channels)
    return pixels if encoding.conversion is None else cv2.cvtColor(pixels, encoding.conversion)


def decode_compressed_image(message: CompressedImage) -> np.ndarray:
    """Return the pixels (H, W, 3) uint8 RGB of a JPEG or PNG image, grey or in colour; an alpha channel is dropped.

    Raises:
        PictureError: see picture_size; or a depth image, or the raw pattern of a Bayer filter.
    """
    encoding, _, compression = message.format.partition(";")
    if "compressedDepth" in message.format:
        raise PictureError(f"image of format {message.format!r} is a depth image: take the topic of the pictures")
    if encoding.startswith("bayer") and not compression.strip().endswith(("bgr8", "rgb8")):
        raise PictureError(
            f"image of format {message.format!r} has no colours yet: take the topic of the colour images"
        )
    try:
        return decode(read_header(bytes(message.data)))
    except ValueError as error:
        raise PictureError(f"{_named(message)} {error}") from error


def picture_size(message: AnyImage) -> tuple[int, int]:
    """Return the width and height of the picture in an image message of either type, without decoding it.

    Raises:
        PictureError: no JPEG or PNG, a damaged one, or one that takes more than any camera's: a few bytes can hold
            gigabytes.
    """
    if not isinstance(message, CompressedImage):
        return message.width, message.height
    try:
        picture = read_header(bytes(message.data))
    except ValueError as error:
        raise PictureError(f"{_named(message)} {error}") from error
    return picture.width, picture.height


def _named(message: CompressedImage) -> str:
    return f"image of format {message.format!r}, {len(message.data)} bytes,"


def decode_camera(message: CameraInfo, rectified: bool = False) -> Camera:
    """Return the camera of the images that come with a CameraInfo, its region of interest and binning taken in.

    Args:
        message: the camera's calibration.
        rectified: whether the images are; their camera is P's, without distortion. Otherwise it is that of K and D.

    Raises:
        ValueError: an uncalibrated camera (K or P of zeros), or values that no camera has.
    """
    matrix = np.reshape(message.p, (3, 4))[:, :3] if rectified else np.reshape(message.k, (3, 3))
    if not np.any(matrix):
        raise ValueError(
            f"camera_info has a {'P' if rectified else 'K'} of zeros, the camera is not calibrated: calibrate it "
            "(camera_calibration) and have the driver load the result (camera_info_url)"
        )
    # Of the whole sensor: zeros stand for all of it, and for single pixels.
    roi, bins = message.roi, (max(message.binning_x, 1), max(message.binning_y, 1))
    width, height = roi.width or message.width, roi.height or message.height
    if roi.x_offset + width > message.width or roi.y_offset + height > message.height:
        raise ValueError(
            f"camera_info has a region of interest of {width}x{height} at {roi.x_offset}, {roi.y_offset}, outside its "
            f"{message.width}x{message.height}"
        )
    try:
        # Drivers leave the name of the model empty when there is no distortion.
        model = "plumb_bob" if rectified else message.distortion_model or "plumb_bob"
        distortion = np.zeros(0) if rectified else np.asarray(message.d)
        offset = np.array([[0, 0, roi.x_offset], [0, 0, roi.y_offset], [0, 0, 0]])
        camera = Camera(width, height, matrix - offset, distortion, model)
        return camera if bins == (1, 1) else camera.scaled(width // bins[0], height // bins[1])
    except ValueError as error:
        raise ValueError(f"camera_info cannot be used: {error}") from error


def decode_picture(message: AnyImage) -> np.ndarray:
    """Return the pixels (H, W, 3) uint8 RGB of an image message of either type.

    Raises:
        ValueError: see decode_image and decode_compressed_image.
    """
    return decode_compressed_image(message) if isinstance(message, CompressedImage) else decode_image(message)


def decode_pose(message: AnyPose | Odometry, name: str) -> np.ndarray:
    """Return the pose (4, 4) of a message in the frame that its header names.

    A quaternion that is not of unit length is normalised. `name` is what errors call the message.

    Raises:
        ValueError: a value that is not finite, or a quaternion of zeros.
    """
    pose = message.pose.pose if isinstance(message.pose, PoseWithCovariance) else message.pose
    position, orientation = pose.position, pose.orientation
    translation = np.array([position.x, position.y, position.z])
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    if not (np.isfinite(translation).all() and np.isfinite(quaternion).all()):
        raise ValueError(
            f"{name} has position {translation.tolist()} and quaternion {quaternion.tolist()}: all must be finite"
        )
    try:
        return make_pose(matrix_from_quaternion(quaternion), translation)
    except ValueError as error:
        raise ValueError(f"{name} cannot be used: {error}") from error


def decode_covariance(message: AnyPose, name: str) -> np.ndarray | None:
    """Return the covariance (6, 6) of a pose in ROS order; None for a pose without one, or with zeros: unknown.

    Raises:
        ValueError: a value that is not finite, or a negative variance.
    """
    if not isinstance(message.pose, PoseWithCovariance) or not np.any(message.pose.covariance):
        return None
    covariance = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    if not np.isfinite(covariance).all() or covariance.diagonal().min() < 0:
        raise ValueError(f"{name} has covariance {covariance.tolist()}: all must be finite, and no variance negative")
    largest = np.abs(covariance).max()
    if largest > _MAX_VARIANCE:
        raise ValueError(f"{name} has covariances up to {largest:g} (at most {_MAX_VARIANCE:g}): zeros mean unknown")
    return covariance


def nanoseconds(stamp: Time) -> int:
    """Return a stamp in nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec
