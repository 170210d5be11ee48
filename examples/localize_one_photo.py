"""Localize one photo in a map, without ROS: python examples/localize_one_photo.py room.ply photo.png"""

import argparse
from pathlib import Path

import numpy as np

from gsfeatloc_ros import Camera, Localizer, LocalizerOptions, create_matcher, create_renderer, load_map, read_photo

# The camera, as calibrated: intrinsics in pixels, distortion as in sensor_msgs/CameraInfo.
K = np.array([[500.0, 0.0, 322.0], [0.0, 502.0, 236.0], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K, distortion=np.array([-0.28, 0.09, 0.0008, -0.0005, 0.0]), model="plumb_bob")

# The prior: roughly where it was and where it looked. Its axes are x right, y down, z forward; those of the map are the
# file's. Here the camera stands 1.5 m above the middle of the room and looks along the map's x axis.
PRIOR = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
OPTIONS = LocalizerOptions(prior_rotation=20.0, prior_translation=0.7)  # how far off it may be: degrees, map units


def localize(map_file: Path, photo_file: Path) -> None:
    image = read_photo(photo_file, upright=True)
    localizer = Localizer(create_renderer(load_map(map_file)), create_matcher("sift"), OPTIONS)
    estimate = localizer.localize(image, CAMERA, PRIOR)
    print(f"{estimate.status.value}: {estimate.reason}")
    if estimate.localized:
        print(estimate.T_map_camera)
        print("standard deviations:", np.sqrt(np.diag(estimate.covariance)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map", type=Path)
    parser.add_argument("photo", type=Path)
    files = parser.parse_args()
    try:
        localize(files.map, files.photo)
    except (ValueError, RuntimeError, OSError) as error:
        parser.exit(2, f"localize_one_photo: {error}\n")
