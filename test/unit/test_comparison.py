"""Photo and render at the estimate, compared both ways and cell by cell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.localize.comparison import CELLS, Comparison, changed_mask, compare
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.query import Components, MatchedView, Query
from gsfeatloc_ros.match import create_matcher, create_tracker
from gsfeatloc_ros.pose.solve import Correspondences, reprojection_errors
from gsfeatloc_ros.render import create_renderer


@pytest.fixture(scope="module")
def components(room_map) -> Components:
    return Components(create_renderer(room_map), create_matcher("sift"), create_tracker, LocalizerOptions())


def compared(components, image: np.ndarray, camera: Camera, pose: np.ndarray) -> tuple[Comparison, Query, MatchedView]:
    """A photo compared with the map seen from a pose."""
    query = Query(components, Photo.undistorted(image, camera, 640), StageClock())
    view = query.track(pose)
    return compare(query, view, errors(query.photo.camera, view), 3.0), query, view


def errors(camera: Camera, view: MatchedView) -> Callable[[Correspondences], np.ndarray]:
    """By how much correspondences are off from the solution of a view."""
    assert view.solution is not None
    return partial(reprojection_errors, camera, view.solution.T_map_camera)


def covered(image: np.ndarray) -> np.ndarray:
    """The photo with a third of it, in the middle, covered by noise."""
    image = image.copy()
    patch = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    image[110:370, 170:480] = cv2.resize(patch, (310, 260), interpolation=cv2.INTER_CUBIC)
    return image


def test_a_photo_agrees_with_the_map_at_the_truth(components, room_camera, room_photos) -> None:
    comparison, *_ = compared(components, room_photos[0].image, room_camera, room_photos[0].T_map_camera)
    assert comparison.inlier_ratio > 0.95
    assert comparison.render_inlier_ratio > 0.95
    assert comparison.explained_correlation > 0.9
    assert comparison.changed < 0.1
    assert comparison.scattered < 0.1
    assert comparison.beyond_map == 0
    assert comparison.correlation.shape == comparison.agreeing.shape == CELLS[::-1]
    assert comparison.agreeing.sum() > 10 * comparison.disagreeing.sum()


@pytest.mark.parametrize("gain", [0.5, 1.3])
@pytest.mark.parametrize("gamma", [0.7, 1.5])
def test_exposure_does_not_count(components, room_camera, room_photos, gain: float, gamma: float) -> None:
    image = room_photos[0].image
    exposed = (255 * np.clip(gain * (image / 255.0) ** gamma, 0, 1)).astype(np.uint8)
    usual, *_ = compared(components, image, room_camera, room_photos[0].T_map_camera)
    comparison, *_ = compared(components, exposed, room_camera, room_photos[0].T_map_camera)
    assert comparison.explained_correlation > usual.explained_correlation - 0.1


def test_what_is_covered_is_told_apart(components, room_camera, room_photos) -> None:
    photo = room_photos[0]
    comparison, query, view = compared(components, covered(photo.image), room_camera, photo.T_map_camera)
    assert comparison.explained_correlation > 0.9
    mask = changed_mask(query.photo, view)
    assert mask.shape == (480, 640)
    assert mask.dtype == np.uint8
    assert set(np.unique(mask)) == {0, 255}
    inside, outside = mask[140:340, 210:440] > 0, np.delete(mask, np.s_[90:390], axis=0) > 0
    assert inside.mean() > 0.7
    assert outside.mean() < 0.1
    assert 0.15 < comparison.changed < 0.45
    # Corners on the cover count against the whole, not against what is as in the map.
    assert comparison.explained_inlier_ratio > 0.97 > comparison.inlier_ratio


def test_what_lies_beside_a_cover_is_as_without_it(components, room_camera, room_photos) -> None:
    photo = room_photos[0]
    usual, *_ = compared(components, photo.image, room_camera, photo.T_map_camera)
    comparison, *_ = compared(components, covered(photo.image), room_camera, photo.T_map_camera)
    compared_beside = np.isfinite(comparison.correlation_beside_changes)
    # Cells that the edge of the cover cuts are compared by what is left of them.
    cut = compared_beside & (comparison.correlation < usual.correlation - 0.1)
    assert cut.sum() >= 10
    assert np.median(comparison.correlation[cut]) < 0.7
    assert np.median((comparison.correlation_beside_changes - usual.correlation)[cut]) > -0.05
    # Most of what is covered is compared with nothing.
    assert compared_beside.sum() < np.isfinite(comparison.correlation).sum() - 20


def test_what_differs_in_small_parts_counts(components, room_camera, room_photos) -> None:
    photo = room_photos[0]
    speckled = photo.image.copy()
    for y, x in np.random.default_rng(0).uniform([0, 0], [460, 620], (300, 2)).astype(int):
        speckled[y : y + 20, x : x + 20] = speckled[y : y + 20, x : x + 20][::-1, ::-1]
    usual, *_ = compared(components, photo.image, room_camera, photo.T_map_camera)
    comparison, *_ = compared(components, speckled, room_camera, photo.T_map_camera)
    assert comparison.explained_correlation < usual.explained_correlation - 0.1
    assert comparison.scattered > usual.scattered + 0.2
    lies_together, *_ = compared(components, covered(photo.image), room_camera, photo.T_map_camera)
    assert lies_together.changed > 0.15
    assert lies_together.scattered < usual.scattered + 0.1


def test_a_wall_seen_from_behind_is_where_most_of_its_mirror_image_is_beyond_the_map(
    components, room_camera, room_photos
) -> None:
    """Splats are seen from both sides: behind the room's wall is the mirror image of what is seen from within."""
    photo = room_photos[0]
    behind = photo.T_map_camera.copy()
    behind[:3, 3] = 9.0, 0.0, 1.5
    behind[:3, :3] = [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    query = Query(components, Photo.undistorted(photo.image, room_camera, 640), StageClock())
    inside, outside = query.track(photo.T_map_camera), query.track(behind)
    found = partial(reprojection_errors, query.photo.camera, photo.T_map_camera)
    assert compare(query, inside, found, 3.0).beyond_map == 0
    assert compare(query, outside, found, 3.0).beyond_map > 0.25


def test_what_disagrees_among_what_agrees_is_told_apart() -> None:
    agreeing, disagreeing, correlation = np.full((12, 16), 8), np.full((12, 16), 2), np.full((12, 16), 0.9)
    scattered = Comparison(0.8, 0.8, agreeing, disagreeing, correlation, correlation, 0.0)
    assert scattered.explained_inlier_ratio == pytest.approx(0.8, abs=1e-3)
    assert scattered.scattered == pytest.approx(0.5 / 193)
    disagreeing[3, 5], correlation[4, 6:9] = 9, 0.4
    assert scattered.scattered == pytest.approx(4.5 / 193)
    # The same numbers, all of what disagrees in one part.
    agreeing[:, 13:], disagreeing[:, :13], correlation[:, 13:] = 0, 0, 0.1
    assert Comparison(0.8, 0.8, agreeing, disagreeing, correlation, correlation, 0.0).explained_inlier_ratio > 0.999
    assert np.isnan(
        Comparison(0.0, 0.0, 0 * agreeing, disagreeing, correlation, correlation, 0.0).explained_inlier_ratio
    )


def test_the_same_in_a_small_photo(components, room_camera, room_photos) -> None:
    small = cv2.resize(room_photos[0].image, (160, 120), interpolation=cv2.INTER_AREA)
    comparison, query, _ = compared(components, small, room_camera.scaled(160, 120), room_photos[0].T_map_camera)
    assert query.photo.camera.K[0, 0] == pytest.approx(500, rel=0.02)
    assert comparison.inlier_ratio > 0.9
    assert comparison.explained_correlation > 0.85


def test_a_blank_photo_has_nothing_to_compare(components, room_camera, room_photos) -> None:
    photo = room_photos[0]
    query = Query(components, Photo.undistorted(photo.image, room_camera, 640), StageClock())
    view = query.track(photo.T_map_camera)
    blank = replace(query.photo, image=np.full_like(query.photo.image, 128))
    view = replace(view, image=np.full_like(query.photo.image, 128))
    assert not changed_mask(blank, view).any()
    comparison = compare(replace(query, photo=blank), view, errors(query.photo.camera, view), 3.0)
    assert np.isnan(comparison.explained_inlier_ratio)
    assert np.isnan(comparison.correlation).all()
    assert np.isnan(comparison.explained_correlation)
    assert np.isnan(comparison.changed)
    assert np.isnan(comparison.scattered)
