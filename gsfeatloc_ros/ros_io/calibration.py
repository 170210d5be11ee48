"""Decode sensor_msgs/CameraInfo, as drivers send it."""

from __future__ import annotations

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.ros_io.message_types import CameraInfo

_POLYNOMIAL, _FISHEYE, _PINHOLE = "polynomial", "fisheye", "pinhole"
# What drivers and calibration tools (camera_calibration, Kalibr, librealsense, simulators) call OpenCV's models. Of
# those that are not OpenCV's only a lens without distortion can be used.
_MODELS = {
    "": _POLYNOMIAL,
    "plumb_bob": _POLYNOMIAL,
    "radtan": _POLYNOMIAL,
    "radial_tangential": _POLYNOMIAL,
    "brown_conrady": _POLYNOMIAL,
    "rational_polynomial": _POLYNOMIAL,
    "equidistant": _FISHEYE,
    "fisheye": _FISHEYE,
    "kannala_brandt": _FISHEYE,
    "kannala_brandt4": _FISHEYE,
    "none": _PINHOLE,
    "pinhole": _PINHOLE,
    "perspective": _PINHOLE,
    "inverse_brown_conrady": _PINHOLE,
    "modified_brown_conrady": _PINHOLE,
}
# Numbers of coefficients of OpenCV's polynomial model, in its order: k1 k2 p1 p2, k3, k4 k5 k6 (rational), s1 s2 s3 s4
# (thin prism), tx ty (tilted sensor).
_COUNTS = (0, 4, 5, 8, 12, 14)
_FISHEYE_COUNT = 4


def decode_camera(message: CameraInfo, rectified: bool = False) -> Camera:
    """Return the camera of the images that come with a CameraInfo, its region of interest and binning taken in.

    The pose that is found is that of the camera which took the raw images, or would have taken the rectified ones. How
    the two are turned against each other (R), and where the other camera of a stereo pair is (the last column of P),
    is not needed for that.

    Args:
        message: the camera's calibration.
        rectified: whether the images are; their camera is P's, without distortion. Otherwise it is that of K and D.

    Raises:
        ValueError: an uncalibrated camera (K or P of zeros), a distortion model that is not known, or values that no
            camera has.
    """
    try:
        matrix = _matrix(message, rectified)
        distortion, model = (np.zeros(0), "plumb_bob") if rectified else _distortion(message)
        # Of the whole sensor: zeros stand for all of it, and for single pixels.
        roi, bins = message.roi, (max(message.binning_x, 1), max(message.binning_y, 1))
        width, height = roi.width or message.width, roi.height or message.height
        region = f"a region of interest of {width}x{height} at {roi.x_offset}, {roi.y_offset}"
        if roi.x_offset + width > message.width or roi.y_offset + height > message.height:
            raise ValueError(f"it has {region}, outside its {message.width}x{message.height}")
        if rectified and roi.do_rectify and (width, height) != (message.width, message.height):
            raise ValueError(f"it has {region} of the raw image: rectify the whole image, or take the raw one")
        offset = np.array([[0, 0, roi.x_offset], [0, 0, roi.y_offset], [0, 0, 0]])
        camera = Camera(width, height, matrix - offset, distortion, model)
        return camera if bins == (1, 1) else camera.scaled(width // bins[0], height // bins[1])
    except ValueError as error:
        raise ValueError(f"camera_info cannot be used: {error}") from error


def _matrix(message: CameraInfo, rectified: bool) -> np.ndarray:
    """Return the intrinsic matrix (3, 3) of the raw or the rectified images."""
    K, P = np.reshape(message.k, (3, 3)), np.reshape(message.p, (3, 4))[:, :3]
    matrix, other = (P, K) if rectified else (K, P)
    if not (message.width and message.height):
        raise ValueError(
            f"its size is {message.width}x{message.height}: have the driver fill in the size of the images that the "
            "camera was calibrated with (camera_info_url)"
        )
    if np.any(matrix):
        return matrix
    name, other_name = ("P", "K") if rectified else ("K", "P")
    if np.any(other):
        raise ValueError(
            f"it has a {name} of zeros, but a {other_name}: if the images are {'raw' if rectified else 'rectified'}, "
            f"set image.rectified:={str(not rectified).lower()}; otherwise calibrate the camera (camera_calibration)"
        )
    raise ValueError(
        f"it has a {name} of zeros, the camera is not calibrated: calibrate it (camera_calibration) and have the "
        "driver load the result (camera_info_url)"
    )


def _distortion(message: CameraInfo) -> tuple[np.ndarray, str]:
    """Return the coefficients, as many as OpenCV takes, and the name of the model, as Camera has them."""
    name = message.distortion_model.strip().lower()
    if name not in _MODELS:
        known = ", ".join(filter(None, _MODELS))
        raise ValueError(
            f"distortion model {message.distortion_model!r} is not one of {known}: rectify the images (image_proc), "
            "take these, and set image.rectified:=true"
        )
    model, given = _MODELS[name], np.asarray(message.d, dtype=np.float64)
    # Drivers fill up with zeros, some to more than the model has.
    used = given[: np.flatnonzero(given)[-1] + 1] if np.any(given) else np.zeros(0)
    most = {_POLYNOMIAL: _COUNTS[-1], _FISHEYE: _FISHEYE_COUNT, _PINHOLE: 0}[model]
    if len(used) > most:
        raise ValueError(
            f"distortion model {message.distortion_model} takes at most {most} coefficients, got {len(used)} that are "
            f"{given.tolist()}"
        )
    if model == _FISHEYE:
        return np.pad(used, (0, _FISHEYE_COUNT - len(used))), "equidistant"
    count = next(count for count in _COUNTS if count >= len(used))
    return np.pad(used, (0, count - len(used))), "plumb_bob" if count <= 5 else "rational_polynomial"
