"""Localize one photo in a map, without ROS: python examples/localize_one_photo.py room.ply photo.png"""

import sys

import cv2
import numpy as np

from gsfeatloc_ros import Camera, Localizer, LocalizerOptions, create_matcher, create_renderer, load_map

map_file, photo_file = sys.argv[1:]
image = cv2.cvtColor(cv2.imread(photo_file), cv2.COLOR_BGR2RGB)

# The camera, as calibrated: intrinsics in pixels, distortion as in sensor_msgs/CameraInfo.
K = np.array([[500.0, 0.0, 322.0], [0.0, 502.0, 236.0], [0.0, 0.0, 1.0]])
camera = Camera(640, 480, K, distortion=np.array([-0.28, 0.09, 0.0008, -0.0005, 0.0]), model="plumb_bob")

# The prior: roughly where it was and where it looked. Its axes are x right, y down, z forward; those of the map are the
# file's. Here the camera stands 1.5 m above the middle of the room and looks along the map's x axis.
prior = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
options = LocalizerOptions(prior_rotation=20.0, prior_translation=0.7)  # how far off it may be: degrees, map units

localizer = Localizer(create_renderer(load_map(map_file)), create_matcher("sift"), options)
estimate = localizer.localize(image, camera, prior)
print(f"{estimate.status.value}: {estimate.reason}")
if estimate.localized:
    print(estimate.T_map_camera)
    print("standard deviations:", np.sqrt(np.diag(estimate.covariance)))
