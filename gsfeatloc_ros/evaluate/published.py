"""The recipe that GSFeatLoc published, for comparison."""

from __future__ import annotations

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose, transform
from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.match.base import Matcher
from gsfeatloc_ros.render.base import Renderer

_MIN_MATCHES = 4
_MAX_REPROJECTION_ERROR = 5.0  # pixels
_ITERATIONS = 50
_FARTHEST = 1e6  # map units


class PublishedLocalizer:
    """One render at the prior, one round of matches, one RANSAC.

    Keypoints are cut to whole pixels in both images and lifted with the depth of that pixel; EPnP in RANSAC (5 pixels,
    50 iterations) gives the pose. The publication answers with the prior when this fails; here that is a FAILED
    estimate, as everywhere, and the evaluation puts the prior in its place.
    """

    def __init__(self, renderer: Renderer, matcher: Matcher, max_image_width: int = 640) -> None:
        self._renderer = renderer
        self._matcher = matcher
        self._max_image_width = max_image_width

    def localize(self, image: np.ndarray, camera: Camera, T_map_camera_prior: np.ndarray) -> Estimate:
        """Estimate where `image` (H, W, 3) uint8 RGB, as observed by `camera`, was taken; see Estimate."""
        image, camera = camera.limit(image, self._max_image_width)
        render = self._renderer.render(camera, T_map_camera_prior)
        matches = self._matcher.match(self._matcher.features(image), self._matcher.features(render.image()))

        columns, rows = np.trunc(matches.b).astype(int).T
        depth = to_host(render.depth[rows, columns]).astype(np.float64)
        lifted = np.isfinite(depth)
        if lifted.sum() < _MIN_MATCHES:
            return Estimate(
                Status.FAILED, f"{lifted.sum()} matches with depth, {_MIN_MATCHES} needed", matches=len(matches)
            )
        rays = camera.rays(np.column_stack([columns, rows])[lifted])
        points = transform(T_map_camera_prior, rays * depth[lifted, None])
        pixels = camera.undistort(np.trunc(matches.a[lifted]))
        solved, rotation_vector, translation, inliers = cv2.solvePnPRansac(
            points,
            pixels,
            camera.K,
            None,
            iterationsCount=_ITERATIONS,
            reprojectionError=_MAX_REPROJECTION_ERROR,
            flags=cv2.SOLVEPNP_EPNP,
        )
        T_camera_map = make_pose(cv2.Rodrigues(rotation_vector)[0], translation.ravel()) if solved else None
        # EPnP of degenerate points gives NaN, or a camera at infinity.
        if T_camera_map is None or not np.abs(T_camera_map).max() < _FARTHEST:
            return Estimate(Status.FAILED, "RANSAC found no pose", matches=len(matches))
        return Estimate(
            Status.LOCALIZED,
            "RANSAC found a pose",
            T_map_camera=invert(T_camera_map),
            matches=len(matches),
            inliers=len(inliers),
            passes=1,
        )
