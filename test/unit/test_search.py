"""The search for a better view, when the prior's has nothing in common with the photo."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsfeatloc_ros.common.geometry import make_pose, rotation_error_deg, so3_exp, so3_log, translation_error
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import StageClock
from gsfeatloc_ros.localize.estimate import Status
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.query import Components, MatchedView, Query
from gsfeatloc_ros.localize.search import SEARCH_WIDTH, agreed_pose, look, promising, spread_poses
from gsfeatloc_ros.maps import Reading
from gsfeatloc_ros.match import create_matcher, create_tracker
from gsfeatloc_ros.render import create_renderer

# However near to each other views are.
ANY = np.full(6, 1e-12)
POSE = make_pose(so3_exp(np.array([0.3, -0.2, 1.0])), np.array([1.0, 2.0, 3.0]))


def steps(poses: list[np.ndarray]) -> np.ndarray:
    """Displacements (N, 6) from POSE: translation and rotation vector, in the map frame."""
    return np.array([np.r_[p[:3, 3] - POSE[:3, 3], so3_log(p[:3, :3] @ POSE[:3, :3].T)] for p in poses])


@settings(deadline=None, max_examples=30)
@given(count=st.integers(0, 40), seed=st.integers(0, 2**32 - 1))
def test_views_stay_within_the_uncertainty_and_come_likely_first(count: int, seed: int) -> None:
    sigmas = np.array([0.5, 0.1, 0.3, 0.2, 0.4, 0.1])
    poses = spread_poses(POSE, np.diag(sigmas**2), ANY, count, seed)
    assert len(poses) == count
    if count:
        distance = np.linalg.norm(steps(poses) / sigmas, axis=1)
        assert distance.max() < 3.3
        assert (np.diff(distance) > -1e-6).all()


def test_views_follow_the_correlations_of_the_prior() -> None:
    root = np.random.default_rng(0).normal(scale=0.2, size=(6, 6))
    covariance = root @ root.T
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), steps(spread_poses(POSE, covariance, ANY, 200, 0)).T)
    # Spread out, not drawn: as wide in all directions, and wider than a normal distribution.
    deviation = np.sqrt(np.linalg.eigvalsh(np.cov(whitened)))
    assert deviation[0] > 0.9
    assert deviation[-1] < 1.8


def test_views_are_spread_more_evenly_than_random_ones() -> None:
    def nearest(points: np.ndarray) -> float:
        distance = np.linalg.norm(points[:, None] - points[None], axis=2) + 100 * np.eye(len(points))
        return float(distance.min())

    random = np.random.default_rng(0).normal(size=(30, 6))
    assert nearest(steps(spread_poses(POSE, np.eye(6) * 0.01, ANY, 30, 0)) / 0.1) > 1.5 * nearest(random)


def test_the_same_seed_gives_the_same_views() -> None:
    a, b = (np.array(spread_poses(POSE, np.eye(6), ANY, 10, seed=3)) for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_a_pose_that_is_known_well_has_fewer_views_around_it() -> None:
    apart = np.array([0.15] * 3 + [np.radians(4.5)] * 3)

    def views(share: float) -> list[np.ndarray]:
        return spread_poses(POSE, share**2 * np.diag((apart / 0.3) ** 2), apart, 32, 0)

    assert len(views(1.0)) == 32
    assert 1 <= len(views(0.1)) < 32
    assert len(views(0.05)) == 0
    for share in (1.0, 0.1):
        points = np.vstack([np.zeros(6), steps(views(share)) / apart])
        distance = np.linalg.norm(points[:, None] - points[None], axis=2)[np.triu_indices(len(points), 1)]
        assert distance.min() > 1 - 1e-6


@pytest.mark.parametrize("covariance", [np.zeros((6, 6)), np.diag([0, 0, 0, 0, 0, 0.1]), -np.eye(6)])
def test_a_covariance_without_extent_is_no_harm(covariance) -> None:
    for pose in spread_poses(POSE, covariance, ANY, 5, 0):
        assert np.isfinite(pose).all()
        np.testing.assert_allclose(pose[:3, 3], POSE[:3, 3])


@pytest.fixture(scope="module")
def renderer(room_map):
    return create_renderer(room_map)


def small_query(renderer, camera, image: np.ndarray) -> Query:
    components = Components(renderer, create_matcher("sift"), create_tracker, LocalizerOptions())
    return Query(components, Photo.undistorted(image, camera, SEARCH_WIDTH), StageClock())


def seen(renderer, camera, image: np.ndarray, views: list[np.ndarray]) -> list[MatchedView]:
    """The views of the map from some poses, beside a photo."""
    return look(small_query(renderer, camera, image), views, same_way_up=False)


def turned(pose: np.ndarray, degrees: float) -> np.ndarray:
    """The camera turned to its side."""
    return pose @ make_pose(so3_exp(np.radians([0.0, degrees, 0.0])), np.zeros(3))


def test_views_that_share_something_with_the_photo_come_first(renderer, room_camera, room_photos) -> None:
    truth = room_photos[0].T_map_camera
    poses = [turned(truth, 180), turned(truth, 20), turned(truth, 5)]
    views = seen(renderer, room_camera, room_photos[0].image, poses)
    np.testing.assert_array_equal(views[-1].pose, poses[0])
    assert views[0].inliers >= views[1].inliers > views[2].inliers
    followed = promising(views)
    assert len(followed) == 2
    for view in followed:
        assert rotation_error_deg(view.solution.T_map_camera, truth) < 2.0
        assert translation_error(view.solution.T_map_camera, truth) < 0.1


def test_views_that_share_nothing_are_not_followed(renderer, room_camera, room_photos) -> None:
    truth = room_photos[0].T_map_camera
    assert promising(seen(renderer, room_camera, room_photos[0].image, [turned(truth, 180)])) == []
    assert promising(seen(renderer, room_camera, room_photos[0].image, [])) == []


def test_views_that_each_have_too_few_matches_agree_on_a_pose(renderer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    query = small_query(renderer, room_camera, photo.image)
    view = query.match(photo.T_map_camera, same_way_up=True)
    agreeing = np.flatnonzero(view.solution.inliers)
    parts = [view.found.select(agreeing[start : start + 5]) for start in (0, 5, 10)]
    agreed = agreed_pose(query, parts)
    assert rotation_error_deg(agreed, photo.T_map_camera) < 2.0
    assert translation_error(agreed, photo.T_map_camera) < 0.1
    # The same five matches three times are five.
    assert agreed_pose(query, [parts[0]] * 3) is None


def test_views_do_not_agree_on_a_pose_that_the_prior_excludes(renderer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    query = small_query(renderer, room_camera, photo.image)
    found = query.match(photo.T_map_camera, same_way_up=True).found
    assert agreed_pose(query, [found]) is not None
    assert agreed_pose(replace(query, plausible=lambda pose: False), [found]) is None


def test_views_without_matches_agree_on_nothing(renderer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    query = small_query(renderer, room_camera, photo.image)
    assert agreed_pose(query, [query.match(photo.T_map_camera, same_way_up=True).found.select([])]) is None


def test_what_is_seen_a_second_time_upside_down_is_no_rival(renderer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    height, width = (side // 2 for side in photo.image.shape[:2])
    covered = photo.image.copy()
    covered[-height:, -width:] = photo.image[:height, :width][::-1, ::-1]
    query = small_query(renderer, room_camera, covered)
    for other in (False, True, False):
        query.match(photo.T_map_camera, other)  # which is kept
    any_way, same_way = (query.match(photo.T_map_camera, same_way_up) for same_way_up in (False, True))
    # Of the part that is seen twice any way finds one or the other.
    half = np.array([query.photo.camera.width, query.photo.camera.height]) / 2

    def inliers_there(view: MatchedView) -> int:
        return int((view.correspondences.a < half).all(axis=1).sum())

    assert inliers_there(same_way) > 1.2 * inliers_there(any_way) > 0
    assert len(same_way.found.pixels) - same_way.inliers < len(any_way.found.pixels) - any_way.inliers


def test_a_camera_upside_down_has_nothing_in_common_the_same_way_up(renderer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    query = small_query(renderer, room_camera, np.ascontiguousarray(photo.image[::-1, ::-1]))
    assert query.match(photo.T_map_camera, same_way_up=False).inliers > 50
    assert query.match(photo.T_map_camera, same_way_up=True).inliers < 10


@pytest.mark.slow
def test_finds_a_camera_that_was_turned_away(renderer, room_camera, room_photos) -> None:
    """The prior looks at another wall. The prior's covariance says how far to look."""
    photo = room_photos[1]
    prior = turned(photo.T_map_camera, 100)
    covariance = np.diag([0.01] * 3 + [1.0] * 3)
    matcher = create_matcher("sift")
    narrow = Localizer(renderer, matcher, LocalizerOptions(max_views=0))
    assert narrow.localize(photo.image, room_camera, prior).status is not Status.LOCALIZED
    estimate = Localizer(renderer, matcher).localize(photo.image, room_camera, prior, covariance)
    assert estimate.localized, estimate.reason
    assert 0 < estimate.evidence.views <= 32
    assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera) < 1.0
    assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.02


def test_easy_photos_search_nothing(renderer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    estimate = Localizer(renderer, create_matcher("sift")).localize(photo.image, room_camera, photo.T_map_camera_prior)
    assert estimate.localized
    assert estimate.evidence.views == 0


def test_a_picture_of_the_place_does_not_end_the_search(renderer, room_camera, room_photos) -> None:
    """What the photo shows is seen from where the prior excludes: what is beside it may be seen from the prior."""
    photo = room_photos[0]
    upside_down = np.ascontiguousarray(photo.image[::-1, ::-1])
    estimate = Localizer(renderer, create_matcher("sift")).localize(upside_down, room_camera, photo.T_map_camera)
    assert estimate.status is Status.REJECTED
    assert "turned by 180 degrees" in estimate.reason
    assert estimate.evidence.views > 8


def test_the_search_ends_with_a_reason(renderer, room_camera) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    doubtful = copy(renderer)
    doubtful.reading = Reading(other="set map.spz_axes:=ply")
    localizer = Localizer(doubtful, create_matcher("sift"), LocalizerOptions(max_views=9))
    estimate = localizer.localize(noise, room_camera, np.eye(4))
    assert not estimate.localized
    assert estimate.evidence.views == 9
    assert "nothing in common" in estimate.reason
    assert estimate.reason.endswith(". set map.spz_axes:=ply")


@pytest.mark.parametrize("covariance", [np.eye(3), np.full((6, 6), np.nan)])
def test_refuses_a_covariance_that_is_none(renderer, room_camera, room_photos, covariance) -> None:
    localizer = Localizer(renderer, create_matcher("sift"))
    with pytest.raises(ValueError, match="covariance"):
        localizer.localize(room_photos[0].image, room_camera, np.eye(4), covariance)
