"""Poses of a photo by the index, whichever way up the photo is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, rotation_error_deg
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.index import IndexOptions, ViewIndex, build_index
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.query import Components, Query
from gsfeatloc_ros.localize.retrieval import retrieve
from gsfeatloc_ros.localize.search import SEARCH_WIDTH
from gsfeatloc_ros.match import Features, Matches, create_tracker
from gsfeatloc_ros.match.nearest import match_mutual
from gsfeatloc_ros.render import create_renderer

# The axes of a camera turned to the right by a quarter, by which pictures turn to the left.
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class UprightSift:
    """SIFT that takes all to be the same way up."""

    upright = True

    def features(self, image: np.ndarray) -> Features:
        sift = cv2.SIFT_create(500)
        keypoints = sift.detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        for keypoint in keypoints:
            keypoint.angle = 0.0
        keypoints, descriptors = sift.compute(image, keypoints)
        descriptors = np.sqrt(descriptors / descriptors.sum(axis=1, keepdims=True))
        pixels = np.array([keypoint.pt for keypoint in keypoints], np.float32)
        return Features(pixels, descriptors, np.array([keypoint.response for keypoint in keypoints], np.float32))

    def match(self, a: Features, b: Features) -> Matches:
        return match_mutual(a, b, max_ratio=0.85)


@pytest.fixture(scope="module")
def renderer(room_map):
    return create_renderer(room_map)


@pytest.fixture(scope="module")
def index(renderer) -> ViewIndex:
    return build_index(renderer, UprightSift(), IndexOptions(views=30))


def turned(photo: Photo, turns: int) -> Photo:
    """The photo turned to the left by so many quarters."""
    for _ in range(turns):
        K, width = photo.camera.K, photo.camera.width
        turned_K = [[K[1, 1], 0, K[1, 2]], [0, K[0, 0], width - 1 - K[0, 2]], [0, 0, 1]]
        image, seen = (np.ascontiguousarray(np.rot90(picture)) for picture in (photo.image, photo.seen))
        photo = Photo(image, seen, Camera(photo.camera.height, width, np.array(turned_K)))
    return photo


def anywhere(pose: np.ndarray) -> bool:
    return True


@pytest.mark.parametrize("turns", range(4))
def test_photos_are_found_whichever_way_up_they_are(renderer, index, room_camera, room_photos, turns: int) -> None:
    found = {True: 0, False: 0}
    for upright in found:
        matcher = UprightSift()
        matcher.upright = upright
        components = Components(renderer, matcher, create_tracker, LocalizerOptions(), index)
        for taken in room_photos[:2]:
            photo = turned(Photo.undistorted(taken.image, room_camera, SEARCH_WIDTH), turns)
            truth = taken.T_map_camera @ make_pose(np.linalg.matrix_power(QUARTER, turns), np.zeros(3))
            hints = [hint for _, hint in retrieve(Query(components, photo, StageClock()), anywhere) if hint]
            best = max(hints, key=lambda hint: hint.inliers, default=None)
            found[upright] += best is not None and rotation_error_deg(best.pose, truth) < 5
    assert found[True] == 2
    # Taken for features that look the same however they are turned, only photos that are upright are found.
    assert found[False] == (2 if turns == 0 else 0)


def test_views_that_were_looked_at_are_left_out(renderer, index, room_camera, room_photos) -> None:
    components = Components(renderer, UprightSift(), create_tracker, LocalizerOptions(), index)
    photo = Photo.undistorted(room_photos[0].image, room_camera, SEARCH_WIDTH)
    query = Query(components, photo, StageClock())
    every, rest = ([hint and hint.inliers for _, hint in retrieve(query, anywhere, n)] for n in (0, 20))
    assert len(every) == 4 * len(index)
    assert rest == every[20:]
