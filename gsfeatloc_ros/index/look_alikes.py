"""Places of a map that look alike, by its index: a photo of one may as well be of another."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, transform
from gsfeatloc_ros.index.view_index import Nearest, ViewIndex
from gsfeatloc_ros.match.base import Features
from gsfeatloc_ros.pose.solve import Correspondences, ransac_pose, reprojection_errors

# Of the landmarks that are nearest to a feature of a picture, those look like it whose distance is less than this share
# of that of the farthest.
_ALIKE = 0.75
# Of a picture 320 wide, what is seen within so many pixels of a feature is what a pose explains it by; so much agrees
# with a pose.
_EXPLAINED = 12.0
_MAX_ERROR = 4.0
# Another place explains so many of a picture's features, and this share of those that the place found does.
_MIN_FEATURES = 8
_MIN_SHARE = 0.2
_MAX_PLACES = 3
# A motion that carries one place to another is found from this many of so many views at least; the best are kept.
_MIN_VIEWS = 2
_MAX_VIEWS = 120
_MAX_MOTIONS = 4
# Motions are the same if they carry what a view shows to places no farther apart than this share of its distance.
_SAME_MOTION = 0.1


def poses_elsewhere(index: ViewIndex, camera: Camera, nearest: Nearest, found: np.ndarray) -> Iterator[np.ndarray]:
    """Yield up to three poses (4, 4), at which the index holds what looks like a picture, the likeliest first.

    Args:
        index: to look in.
        camera: of the picture, without distortion, about 320 pixels wide.
        nearest: what of the index looks like the picture's features.
        found: pose (4, 4) of the picture; what it explains is left out.
    """
    feature, neighbour = np.nonzero(nearest.distances < _ALIKE**2 * nearest.distances[:, -1:])
    alike = index.points_of(nearest.landmarks[feature, neighbour])
    left = Correspondences(nearest.pixels[feature].astype(np.float64), alike, np.zeros_like(alike))
    explained = reprojection_errors(camera, found, left) <= _EXPLAINED
    least = max(_MIN_FEATURES, _MIN_SHARE * _distinct(left.select(explained)))
    for _ in range(_MAX_PLACES):
        left = left.select(~explained)
        solved = ransac_pose(camera, left, _MAX_ERROR, seed=0)
        if solved is None or _distinct(left.select(solved[1])) < least:
            return
        yield solved[0]
        explained = reprojection_errors(camera, solved[0], left) <= _EXPLAINED


def find_look_alikes(index: ViewIndex, camera: Camera) -> np.ndarray:
    """Return the motions (S, 4, 4) of the map frame, that carry what several views show to where it looks alike.

    They hold for what the index knows on one side only, too: two rooms are alike as a whole.

    Args:
        index: of the map.
        camera: of its views.
    """
    motions: list[np.ndarray] = []
    views: list[int] = []
    for view in range(0, len(index), -(-len(index) // _MAX_VIEWS)):
        pose = index.poses[view]
        descriptors, points = index.contents(view)
        pixels = camera.project(transform(invert(pose), points)).astype(np.float32)
        features = Features(pixels, descriptors, np.ones(len(pixels), np.float32))
        distance = np.median(np.linalg.norm(points - pose[:3, 3], axis=1))
        for elsewhere in poses_elsewhere(index, camera, index.nearest(features), pose):
            motion = elsewhere @ invert(pose)
            carried = transform(motion, points)
            gaps = [np.median(np.linalg.norm(transform(known, points) - carried, axis=1)) for known in motions]
            if gaps and min(gaps) < _SAME_MOTION * distance:
                views[int(np.argmin(gaps))] += 1
            else:
                motions.append(motion)
                views.append(1)
    order = np.argsort(views, kind="stable")[::-1][:_MAX_MOTIONS]
    return np.array([motions[number] for number in order if views[number] >= _MIN_VIEWS]).reshape(-1, 4, 4)


def _distinct(found: Correspondences) -> int:
    """Return of how many pixels they are."""
    return len(np.unique(found.pixels, axis=0))
