"""The recipe that GSFeatLoc published, for comparison."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose, transform
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.localize.estimate import Estimate, Status, Trace
from gsfeatloc_ros.localize.evidence import Evidence
from gsfeatloc_ros.match.base import Matcher
from gsfeatloc_ros.render.base import Renderer

_MIN_MATCHES = 4
_MAX_REPROJECTION_ERROR = 5.0  # pixels
_MAX_ITERATIONS = 50
# Largest number in a pose that is one: EPnP of degenerate points gives NaN, or a camera at infinity. Map units.
_MAX_COORDINATE = 1e6


class PublishedLocalizer:
    """Localize by one render at the prior, one round of matches and one RANSAC, with the interface of Localizer.

    Keypoints are cut to whole pixels in both images and lifted with the depth of that pixel; EPnP in RANSAC (5 pixels,
    50 iterations) gives the pose. The publication answers with the prior when this fails; here that is a FAILED
    estimate, as everywhere, and the evaluation puts the prior in its place.
    """

    def __init__(self, renderer: Renderer, matcher: Matcher, max_image_width: int = 640) -> None:
        self._renderer = renderer
        self._matcher = matcher
        self._max_image_width = max_image_width

    def localize(
        self,
        image: np.ndarray,
        camera: Camera,
        T_map_camera_prior: np.ndarray | None = None,
        prior_covariance: np.ndarray | None = None,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> Estimate:
        """Localize a photo.

        Args:
            image: (H, W, 3) uint8 RGB as the camera gave it, distorted.
            camera: its intrinsics and distortion, of the same size.
            T_map_camera_prior: (4, 4) prior of the camera (optical axes) in the map frame.
            prior_covariance: not used: the recipe does not search around the prior.
            interrupted: whether to give up, asked before rendering and before matching.

        Raises:
            Interrupted: `interrupted` said so.
        """
        if T_map_camera_prior is None:
            return Estimate(Status.FAILED, "the published recipe needs a prior")
        image, camera = camera.limit(image, self._max_image_width)
        _give_up_if(interrupted)
        render = self._renderer.render(camera, T_map_camera_prior)
        _give_up_if(interrupted)
        matches = self._matcher.match(self._matcher.features(image), self._matcher.features(render.image()))

        columns, rows = np.trunc(matches.b).astype(int).T
        depth = to_host(render.depth[rows, columns]).astype(np.float64)
        lifted = np.isfinite(depth)
        evidence = Evidence(matches=len(matches), lifted=int(lifted.sum()))
        if evidence.lifted < _MIN_MATCHES:
            reason = f"{evidence.lifted} matches with depth, {_MIN_MATCHES} needed"
            return Estimate(Status.FAILED, reason, evidence=evidence)
        rays = camera.rays(np.column_stack([columns, rows])[lifted])
        points = transform(T_map_camera_prior, rays * depth[lifted, None])
        pixels = camera.undistort(np.trunc(matches.a[lifted]))
        solved, rotation_vector, translation, inliers = cv2.solvePnPRansac(
            points,
            pixels,
            camera.K,
            None,
            iterationsCount=_MAX_ITERATIONS,
            reprojectionError=_MAX_REPROJECTION_ERROR,
            flags=cv2.SOLVEPNP_EPNP,
        )
        T_camera_map = make_pose(cv2.Rodrigues(rotation_vector)[0], translation.ravel()) if solved else None
        if T_camera_map is None or not np.abs(T_camera_map).max() < _MAX_COORDINATE:
            return Estimate(Status.FAILED, "RANSAC found no pose", evidence=evidence)
        evidence = replace(evidence, inliers=len(inliers), passes=1)
        return Estimate(Status.LOCALIZED, "RANSAC found a pose", invert(T_camera_map), evidence=evidence)

    def trace(
        self,
        image: np.ndarray,
        camera: Camera,
        T_map_camera_prior: np.ndarray | None = None,
        prior_covariance: np.ndarray | None = None,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> Trace:
        """Localize a photo; the trace has no render, as the recipe does not render at its answer."""
        estimate = self.localize(image, camera, T_map_camera_prior, prior_covariance, interrupted)
        return Trace(estimate, Photo.undistorted(image, camera, self._max_image_width))


def _give_up_if(interrupted: Callable[[], bool]) -> None:
    if interrupted():
        raise Interrupted
