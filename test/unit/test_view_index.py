"""Views by their features: compressed, searched and matched."""

from __future__ import annotations

from dataclasses import replace

import faiss
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from view_indices import landmarks_of, made_up_index, photo_of, unit_vectors

from gsfeatloc_ros.index import ViewIndex
from gsfeatloc_ros.match import Features


def votes_of(index: ViewIndex, features: Features) -> np.ndarray:
    return index.rank(index.nearest(features))


@settings(max_examples=15)
@given(views=st.integers(1, 30), features=st.integers(1, 60), dimension=st.sampled_from([64, 128]), data=st.data())
def test_the_view_of_the_photo_comes_first_and_its_points_come_back(views, features, dimension, data) -> None:
    made = made_up_index(views, features, dimension, seed=data.draw(st.integers(0, 1000)))
    view = data.draw(st.integers(0, views - 1))
    photo = photo_of(made.descriptors[view], noise=0.2)
    votes = votes_of(made.index, photo)
    assert votes.shape == (views,)
    assert votes[view] == votes.max() == features
    matches, points = made.index.match(photo, view)
    assert len(matches) == len(points)
    assert len(matches) >= 0.9 * features
    # The x of a keypoint is its feature's number.
    truth = made.points[view][matches.a[:, 0].astype(int)]
    step = (made.index.high - made.index.low) / 65535
    assert np.mean((np.abs(points - truth) <= 0.5 * step + 1e-9).all(axis=1)) >= 0.9


def test_features_of_elsewhere_match_hardly_anything() -> None:
    made = made_up_index(views=10, features=60, dimension=128)
    matches, _ = made.index.match(photo_of(unit_vectors(np.random.default_rng(1), 200, 128)), 3)
    assert len(matches) < 10


def test_a_feature_seen_again_and_again_has_one_vote_a_view() -> None:
    made = made_up_index(views=3, features=20, dimension=128)
    repeated = np.repeat(made.descriptors[1][:1], 20, axis=0)
    landmarks = landmarks_of([made.descriptors[0], repeated, made.descriptors[2]], made.points)
    index = ViewIndex.compress(made.index.poses, landmarks)
    votes = votes_of(index, photo_of(np.concatenate([made.descriptors[0][:5], repeated[:1]])))
    assert votes[1] <= 6
    assert votes[0] >= 5


def test_a_landmark_speaks_for_all_views_that_show_it() -> None:
    made = made_up_index(views=3, features=20, dimension=128)
    landmarks = landmarks_of(made.descriptors, made.points)
    shared = [landmarks.seen[0], np.r_[landmarks.seen[0][:15], landmarks.seen[1]], landmarks.seen[2]]
    index = ViewIndex.compress(made.index.poses, replace(landmarks, seen=shared))
    votes = votes_of(index, photo_of(made.descriptors[0]))
    assert votes[0] == 20
    assert votes[1] >= 15
    assert len(index.match(photo_of(made.descriptors[0]), 1)[0]) >= 14


def test_an_index_of_one_feature_is_searched() -> None:
    made = made_up_index(views=1, features=1, dimension=128)
    photo = photo_of(made.descriptors[0])
    assert votes_of(made.index, photo).tolist() == [1.0]
    matches, points = made.index.match(photo, 0)
    assert len(matches) == 1
    np.testing.assert_allclose(points, made.points[0])


def test_fewer_features_than_are_voted_for() -> None:
    made = made_up_index(views=3, features=1, dimension=64)
    assert (votes_of(made.index, photo_of(made.descriptors[2])) == 1).all()


def test_a_photo_without_features_speaks_for_no_view() -> None:
    made = made_up_index(views=3, features=5, dimension=128)
    assert votes_of(made.index, Features.none(128)).tolist() == [0, 0, 0]
    matches, points = made.index.match(Features.none(128), 0)
    assert len(matches) == len(points) == 0


def test_views_in_one_plane_keep_their_points() -> None:
    made = made_up_index(views=2, features=10, dimension=128)
    flat = [points * [1, 1, 0] + [0, 0, 7] for points in made.points]
    index = ViewIndex.compress(made.index.poses, landmarks_of(made.descriptors, flat))
    _, points = index.match(photo_of(made.descriptors[0]), 0)
    np.testing.assert_allclose(points[:, 2], 7)


def test_the_same_views_give_the_same_index() -> None:
    a, b = (made_up_index(views=20, features=50, dimension=128).index for _ in range(2))
    for name, array in vars(a).items():
        np.testing.assert_array_equal(array, getattr(b, name))
    photo = photo_of(unit_vectors(np.random.default_rng(0), 100, 128))
    np.testing.assert_array_equal(votes_of(a, photo), votes_of(b, photo))


def test_what_faiss_is_told_for_the_compression_holds_for_it_alone() -> None:
    usual = faiss.cvar.distance_compute_blas_threshold
    made_up_index(views=3, features=20, dimension=128)
    assert faiss.cvar.distance_compute_blas_threshold == usual


@pytest.mark.parametrize("dimension", [1, 100])
def test_nothing_is_no_index(dimension: int) -> None:
    with pytest.raises(ValueError, match="no view of it has features"):
        ViewIndex.compress(np.empty((0, 4, 4)), landmarks_of([np.empty((0, dimension))], [np.empty((0, 3))]))


def test_descriptors_that_cannot_be_compressed_are_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="multiple of 32"):
        ViewIndex.compress(np.eye(4)[None], landmarks_of([unit_vectors(rng, 300, 100)], [rng.random((300, 3))]))
