"""Places that look alike by their features, wherever these are."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from view_indices import landmarks_of, photo_of, unit_vectors

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, rotation_error_deg, so3_exp, transform, translation_error
from gsfeatloc_ros.index import ViewIndex
from gsfeatloc_ros.index.look_alikes import find_look_alikes, poses_elsewhere
from gsfeatloc_ros.match import Features

CAMERA = Camera(320, 240, np.array([[288.0, 0, 159.5], [0, 288.0, 119.5], [0, 0, 1]]))


def made_up_place(seed: int, views: int = 4, features: int = 40):
    """Poses of views, the descriptors of each, and points that it sees."""
    rng = np.random.default_rng(seed)
    poses = [make_pose(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(views)]
    seen = [rng.uniform([-1, -0.8, 2], [1, 0.8, 6], (features, 3)) for _ in range(views)]
    descriptors = [unit_vectors(rng, features, 128) for _ in range(views)]
    return poses, descriptors, [transform(pose, points) for pose, points in zip(poses, seen, strict=True)]


def twins(motion: np.ndarray, seed: int = 0) -> ViewIndex:
    """An index of a place and of its copy, carried there by a motion (4, 4)."""
    poses, descriptors, points = made_up_place(seed)
    there = [transform(motion, p) for p in points]
    landmarks = landmarks_of(2 * descriptors, points + there)
    return ViewIndex.compress(np.array(poses + [motion @ pose for pose in poses]), landmarks)


def are_near(pose: np.ndarray, truth: np.ndarray) -> bool:
    return rotation_error_deg(pose, truth) < 1.0 and translation_error(pose, truth) < 0.1


motions = st.builds(
    lambda turn, x, y: make_pose(so3_exp(np.array([0, 0, turn])), np.array([x, y, 0.5])),
    st.floats(-3.1, 3.1),
    st.floats(15, 40),
    st.floats(-40, 40),
)


@settings(max_examples=10)
@given(motion=motions, seed=st.integers(0, 1000))
def test_the_motions_to_a_copy_and_back_are_found(motion: np.ndarray, seed: int) -> None:
    found = find_look_alikes(twins(motion, seed), CAMERA)
    assert len(found) == 2
    for expected in (motion, np.linalg.inv(motion)):
        # Compared where the place is, not at the origin of the map.
        at = motion if expected is not motion else np.eye(4)
        assert any(are_near(one @ at, expected @ at) for one in found)


def test_places_that_are_not_alike_have_no_motion() -> None:
    poses, descriptors, points = made_up_place(0, views=8)
    index = ViewIndex.compress(np.array(poses), landmarks_of(descriptors, points))
    assert find_look_alikes(index, CAMERA).shape == (0, 4, 4)


def test_a_picture_is_found_at_the_copy_and_nowhere_else() -> None:
    motion = make_pose(np.eye(3), np.array([20.0, 0, 0]))
    index = twins(motion)
    poses, descriptors, points = made_up_place(0)
    pixels = CAMERA.project((points[1] - poses[1][:3, 3]) @ poses[1][:3, :3]).astype(np.float32)
    features = Features(pixels, photo_of(descriptors[1], noise=0.1).descriptors, np.ones(len(pixels), np.float32))
    (elsewhere,) = poses_elsewhere(index, CAMERA, index.nearest(features), poses[1])
    assert are_near(elsewhere, motion @ poses[1])
    (back,) = poses_elsewhere(index, CAMERA, index.nearest(features), motion @ poses[1])
    assert are_near(back, poses[1])


def test_nothing_is_like_a_picture_of_nothing() -> None:
    index = twins(make_pose(np.eye(3), np.array([20.0, 0, 0])))
    assert list(poses_elsewhere(index, CAMERA, index.nearest(Features.none(128)), np.eye(4))) == []
