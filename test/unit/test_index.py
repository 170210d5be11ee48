"""The index of views of a map: made, kept beside the map, and what it is for."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_maps import one_gaussian

from gsfeatloc_ros.common.geometry import rotation_error_deg, translation_error
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.index import IndexOptions, ViewIndex, build_index
from gsfeatloc_ros.index.storage import index_path, load_index
from gsfeatloc_ros.localize.engine import Engine
from gsfeatloc_ros.localize.estimate import Status
from gsfeatloc_ros.localize.evidence import Limits
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.map_index import index_for, index_key
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import MapSettings, MatcherSettings
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.render import Renderer, create_renderer
from gsfeatloc_ros.simulate.photos import Walk

FEW = IndexOptions(views=3)


@pytest.fixture(scope="module")
def renderer(room_map) -> Renderer:
    return create_renderer(room_map)


@pytest.fixture(scope="module")
def matcher():
    return create_matcher("sift")


@pytest.fixture(scope="module")
def index(renderer, matcher) -> ViewIndex:
    return build_index(renderer, matcher, IndexOptions(views=30))


# Made


def test_a_photo_without_a_prior_is_localized(renderer, matcher, index, room_camera, room_photos) -> None:
    localizer = Localizer(renderer, matcher, index=index)
    for photo in room_photos[:4]:
        estimate = localizer.localize(photo.image, room_camera)
        assert estimate.status is Status.LOCALIZED, estimate.reason
        assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera) < 1.0
        assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.02
        assert estimate.evidence.index_views == len(index) == 30
        assert 0 < estimate.evidence.searched <= 30
        assert np.isnan(estimate.evidence.deviation)


def test_where_the_mirror_image_fits_too_the_better_one_is_believed(
    renderer, matcher, index, room_camera, room_photos, monkeypatch
) -> None:
    """Without a prior, where so little risk is accepted that no photo is sure enough by itself."""
    image = room_photos[0].image
    options = LocalizerOptions(limits=Limits(max_risk=1e-9))
    localizer = Localizer(renderer, matcher, options, index=index)
    answer = localizer.localize(image, room_camera)
    assert answer.localized
    assert answer.evidence.mirror_probability_wrong == 1.0 > 1e-9 > answer.evidence.probability_wrong
    # As if the camera flipped its images: the mirror image is what it really saw.
    true = Photo.undistorted(image, room_camera, 640)
    monkeypatch.setattr(Photo, "mirrored", lambda photo: true)
    refusal = localizer.localize(image, room_camera)
    assert refusal.status is Status.REJECTED
    assert "is the image flipped?" in refusal.reason


def test_a_photo_of_nothing_in_the_map_is_not(renderer, matcher, index, room_camera) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    estimate = Localizer(renderer, matcher, index=index).localize(noise, room_camera)
    assert estimate.status is Status.FAILED
    assert "30 of 30 views of the map" in estimate.reason


def test_points_of_views_are_on_what_they_show(room, index) -> None:
    points = index.low + index.points / 65535 * (index.high - index.low)
    surfaces = np.min([np.abs(solid.distance(points)) for solid in room.solids], axis=0)
    assert np.quantile(surfaces, 0.95) < 0.08
    assert ((index.counts > 0) & (index.counts <= 225)).all()


def test_the_same_seed_gives_the_same_index(renderer, matcher) -> None:
    a, b, other = (build_index(renderer, matcher, replace(FEW, seed=seed)) for seed in (1, 1, 2))
    for name, array in vars(a).items():
        np.testing.assert_array_equal(array, getattr(b, name))
    assert not np.array_equal(a.poses, other.poses)


def test_given_poses_are_chosen_first(renderer, matcher) -> None:
    given = np.array([Walk(np.zeros(4)).pose(time) for time in range(0, 30, 5)])
    index = build_index(renderer, matcher, FEW, poses=given)
    assert len(index) == 3
    for pose in index.poses:
        assert np.isclose(pose, given).all(axis=(1, 2)).any()


def test_progress_goes_on_to_its_end(renderer, matcher) -> None:
    reports: list[tuple[int, int]] = []
    build_index(renderer, matcher, FEW, progress=lambda *report: reports.append(report))
    done, totals = zip(*reports, strict=True)
    assert len(set(totals)) == 1
    assert list(done) == sorted(done)
    assert done[-1] == totals[0]
    assert len(done) > 30


@pytest.mark.parametrize("calls", [0, 20, 35])
def test_it_can_be_interrupted(renderer, matcher, calls: int) -> None:
    asked = iter(range(1000))
    with pytest.raises(Interrupted):
        build_index(renderer, matcher, FEW, interrupted=lambda: next(asked) >= calls)
    assert next(asked) == calls + 1


@pytest.mark.parametrize(
    ("opacity", "says"), [(0.3, "nothing in the map is solid"), (0.9, "nothing that could be recognized")]
)
def test_a_map_of_nothing_cannot_be_recognized(matcher, opacity: float, says: str) -> None:
    renderer = create_renderer(one_gaussian([0.0, 0.0, 0.0], 0.5, opacity))
    with pytest.raises(ValueError, match=says) as failure:
        build_index(renderer, matcher, FEW)
    assert "\n" not in str(failure.value)


# Kept


@pytest.fixture
def map_path(tmp_path, room_map_file) -> Path:
    """A map in a folder of its own."""
    path = tmp_path / "room.ply"
    path.symlink_to(room_map_file)
    return path


@pytest.fixture
def engine(map_path, renderer, matcher) -> Engine:
    return Engine(str(map_path), renderer, matcher, LocalizerOptions())


@pytest.fixture
def key(map_path):
    return index_key(str(map_path), MapSettings(), MatcherSettings(), IndexOptions())


def refuse(*arguments) -> None:
    raise AssertionError("the index is made again")


def test_an_index_is_made_once(engine, map_path, key, caplog) -> None:
    made = index_for(engine, FEW, key)
    assert made is not None
    read = index_for(engine, replace(FEW, views=100, seed=7), key, progress=refuse)
    assert read is not None
    np.testing.assert_array_equal(read.codes, made.codes)
    stored = load_index(index_path(map_path), key)
    assert stored is not None
    np.testing.assert_array_equal(stored.poses, made.poses)
    assert not caplog.records


def test_a_damaged_index_is_made_again_with_a_warning(engine, map_path, key, caplog) -> None:
    path = index_path(map_path)
    made = index_for(engine, FEW, key)
    assert made is not None
    path.write_bytes(path.read_bytes()[:-1])
    again = index_for(engine, FEW, key)
    assert again is not None
    np.testing.assert_array_equal(again.codes, made.codes)
    (warning,) = caplog.records
    assert warning.levelno == logging.WARNING
    assert str(path) in warning.getMessage()
    assert "made again" in warning.getMessage()
    assert index_for(engine, FEW, key, progress=refuse) is not None


def test_without_leave_to_make_one_there_is_none(engine, map_path, key) -> None:
    assert index_for(engine, replace(FEW, build=False), key, progress=refuse) is None
    assert not index_path(map_path).exists()


def test_an_index_that_cannot_be_kept_serves_all_the_same(engine, key, caplog) -> None:
    made = index_for(engine, replace(FEW, path="/proc/nowhere/room.index"), key)
    assert made is not None
    assert len(made) == 3
    (warning,) = caplog.records
    assert "cannot be written" in warning.getMessage()


def test_the_index_of_another_map_place_or_matcher_is_made_anew(engine, map_path, key, tmp_path) -> None:
    other = tmp_path / "other.ply"
    other.write_bytes(map_path.read_bytes()[:-1])
    keys = [
        key,
        index_key(str(other), MapSettings(), MatcherSettings(), IndexOptions()),
        index_key(str(map_path), MapSettings(scale=2.0), MatcherSettings(), IndexOptions()),
        index_key(str(map_path), MapSettings(translation=(1.0, 0.0, 0.0)), MatcherSettings(), IndexOptions()),
        index_key(str(map_path), MapSettings(), MatcherSettings(name="xfeat"), IndexOptions()),
    ]
    assert index_for(engine, FEW, key) is not None
    for number, wanted in enumerate(keys):
        found = index_for(engine, replace(FEW, build=False), wanted)
        assert (found is not None) == (number == 0)


def test_a_copy_of_the_map_has_the_same_index(map_path, key, tmp_path) -> None:
    copy = tmp_path / "copy.ply"
    copy.write_bytes(map_path.read_bytes())
    assert index_key(str(copy), MapSettings(path=str(copy)), MatcherSettings(), IndexOptions()) == key
