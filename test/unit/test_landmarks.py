"""Landmarks of views, against a scene in which it is known who shows what."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from view_indices import unit_vectors

from gsfeatloc_ros.common.geometry import make_pose
from gsfeatloc_ros.index.landmarks import View, merge


def scene(views: int, things: int, seed: int) -> tuple[list[View], list[np.ndarray], np.ndarray]:
    """Views that show random things, far apart and unlike each other; which each shows; the points (things, 3)."""
    rng = np.random.default_rng(seed)
    points, looks = 10.0 * rng.permutation(things)[:, None] + [0.0, 0.0, 5.0], unit_vectors(rng, things, 128)
    shown = [rng.permutation(things)[: rng.integers(0, things + 1)] for _ in range(views)]
    made = []
    for things_shown in shown:
        descriptors = looks[things_shown] + 0.1 * unit_vectors(rng, len(things_shown), 128)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        near = points[things_shown] + rng.normal(0, 0.005, (len(things_shown), 3))
        made.append(View(make_pose(np.eye(3), np.zeros(3)), descriptors.astype(np.float32), near))
    return made, shown, points


@settings(max_examples=30)
@given(views=st.integers(0, 6), things=st.integers(1, 20), seed=st.integers(0, 1000))
def test_a_landmark_is_what_several_views_show(views: int, things: int, seed: int) -> None:
    made, shown, points = scene(views, things, seed)
    landmarks = merge(made)
    confirmed = {t for t in range(things) if sum(t in of_view for of_view in shown) >= 2}
    assert len(landmarks.points) == len(landmarks.descriptors) == len(confirmed)
    thing = {tuple(np.round(points[t]).astype(int)): t for t in confirmed}
    names = [thing[tuple(np.round(point).astype(int))] for point in landmarks.points]
    for of_view, seen in zip(shown, landmarks.seen, strict=True):
        # In the order of the features: the strongest first.
        assert [names[number] for number in seen] == [t for t in of_view if t in confirmed]
    if confirmed:
        np.testing.assert_allclose(np.linalg.norm(landmarks.descriptors, axis=1), 1, rtol=1e-5)


def test_what_lies_elsewhere_or_looks_otherwise_is_another_landmark() -> None:
    rng = np.random.default_rng(0)
    look, other = unit_vectors(rng, 2, 128)
    near, far = np.array([0, 0, 5.0]), np.array([0, 0, 5.2])
    views = [
        View(np.eye(4), np.array([descriptor]), np.array([point]))
        for descriptor, point in ((look, near), (look, far), (other, near))
    ]
    assert len(merge(views).points) == 0
    assert len(merge([*views, *views]).points) == 3


def test_a_view_that_shows_the_same_twice_has_it_once() -> None:
    look = unit_vectors(np.random.default_rng(0), 1, 128)
    twice = View(np.eye(4), np.repeat(look, 2, axis=0), np.array([[0, 0, 5.0]] * 2))
    once = View(np.eye(4), look, np.array([[0, 0, 5.0]]))
    assert [seen.tolist() for seen in merge([twice, once]).seen] == [[0], [0]]
    assert len(merge([twice]).points) == 0


@given(most=st.integers(1, 10), seed=st.integers(0, 100))
def test_only_landmarks_of_the_views_that_are_kept_are_left(most: int, seed: int) -> None:
    made, _, _ = scene(views=5, things=12, seed=seed)
    landmarks = merge(made)
    views = [3, 0]
    kept = landmarks.of_views(views, most)
    for view, seen in zip(views, kept.seen, strict=True):
        np.testing.assert_array_equal(kept.points[seen], landmarks.points[landmarks.seen[view][:most]])
    assert len(kept.points) == len({number for view in views for number in landmarks.seen[view][:most].tolist()})
    assert landmarks.of_views([], most).points.shape == (0, 3)
