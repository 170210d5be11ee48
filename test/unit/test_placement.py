"""Where a map is looked at from."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from small_maps import small_camera

from gsfeatloc_ros.common.geometry import make_pose, so3_exp, transform
from gsfeatloc_ros.index.options import IndexOptions
from gsfeatloc_ros.index.placement import cells, cover, overlap, radius, random_poses, seen_cells, sees
from gsfeatloc_ros.render import Render

POSE = make_pose(so3_exp(np.array([0.3, -0.2, 1.0])), np.array([1.0, 2.0, 3.0]))
ANYWHERE = IndexOptions()
CLOUD = np.random.default_rng(0).uniform([-3, -2, 0], [3, 2, 1], (500, 3))


some_worth = arrays(np.float32, st.tuples(st.integers(1, 5), st.integers(0, 6)), elements=st.integers(0, 4).map(float))


def found(worth: np.ndarray, chosen: list[int]) -> float:
    """What the photos find in the views that were chosen."""
    return float(worth[:, chosen].max(axis=1, initial=0).sum())


@given(worth=some_worth, count=st.integers(0, 4))
def test_chosen_views_suit_the_photos_nearly_as_well_as_the_best_choice(worth, count) -> None:
    chosen = cover(worth, count)
    assert len(chosen) == len(set(chosen)) <= count
    views = range(worth.shape[1])
    best = max(found(worth, list(choice)) for choice in itertools.combinations(views, min(count, len(views))))
    assert best >= found(worth, chosen) >= (1 - 1 / math.e) * best


@given(worth=some_worth, count=st.integers(0, 4))
def test_each_chosen_view_is_the_one_that_adds_most(worth, count) -> None:
    before: list[int] = []
    for view in cover(worth, count):
        gains = [found(worth, [*before, other]) - found(worth, before) for other in range(worth.shape[1])]
        assert gains[view] == max(gains) > 0
        before.append(view)


some_views = st.lists(st.sets(st.integers(0, 12), max_size=6), max_size=7)


@given(photos=some_views, views=some_views)
def test_overlap_is_the_share_of_a_photo_that_a_view_shows(photos, views) -> None:
    expected = [[len(photo & view) / max(len(photo), 1) for view in views] for photo in photos]
    np.testing.assert_allclose(overlap(photos, views), np.reshape(expected, (len(photos), len(views))), rtol=1e-6)


def test_nothing_is_chosen_of_nothing() -> None:
    assert cover(np.zeros((0, 0)), 5) == []
    assert cover(np.zeros((3, 2)), 5) == []


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), shift=st.floats(-1e3, 1e3), scale=st.floats(1e-3, 1e3))
def test_random_poses_aim_at_a_point(seed: int, shift: float, scale: float) -> None:
    points = shift + scale * CLOUD
    for pose, target in zip(*random_poses(points, 20, np.random.default_rng(seed), ANYWHERE), strict=True):
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(pose[:3, :3]) > 0
        assert (points == target).all(axis=1).any()
        x, y, z = pose[:3, :3].T @ (target - pose[:3, 3])
        assert np.hypot(x, y) < 1e-6 * (abs(shift) + scale)
        assert z > 0


@given(height=st.floats(0.01, 5.0), pitch=st.floats(-90.0, 90.0))
def test_a_robot_on_the_plane_looks_from_its_camera_and_faces_what_it_looks_at(height: float, pitch: float) -> None:
    options = IndexOptions(camera_height=height, camera_pitch=pitch)
    poses, targets = random_poses(CLOUD, 20, np.random.default_rng(0), options)
    np.testing.assert_allclose(poses[:, 2, 3], height)
    np.testing.assert_allclose(poses[:, 2, 2], np.sin(np.radians(pitch)), atol=1e-9)
    for pose, target in zip(poses, targets, strict=True):
        to_target, ahead = (target - pose[:3, 3])[:2], pose[:2, 2]
        assert to_target @ ahead >= 0
        # In the vertical plane through the camera's axis, however near that is to the vertical itself.
        assert abs(to_target[0] * ahead[1] - to_target[1] * ahead[0]) < 1e-9


def test_random_poses_are_nearly_upright() -> None:
    """But for those that look up or down."""
    poses, _ = random_poses(CLOUD, 400, np.random.default_rng(0), ANYWHERE)
    level = poses[np.abs(poses[:, 2, 2]) < 0.7]
    assert len(level) > 100
    assert (level[:, 2, 1] < -0.5).all()  # what is down in the picture
    assert 0.02 < np.std(level[:, 2, 0]) < 0.2  # what is right in it


def test_random_poses_lie_inside_and_around() -> None:
    positions = random_poses(CLOUD, 400, np.random.default_rng(0), ANYWHERE)[0][:, :3, 3]
    inside = ((positions > CLOUD.min(axis=0)) & (positions < CLOUD.max(axis=0))).all(axis=1)
    assert 0.2 < inside.mean() < 0.8
    distances = np.linalg.norm(positions[:, None] - CLOUD, axis=2).min(axis=1)
    assert distances.max() < 2.5 * radius(CLOUD)


def test_the_same_seed_gives_the_same_poses() -> None:
    a, b, c = (random_poses(CLOUD, 10, np.random.default_rng(seed), ANYWHERE)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.allclose(a, c)


def test_a_single_point_is_looked_at() -> None:
    poses, _ = random_poses(np.ones((1, 3)), 5, np.random.default_rng(0), ANYWHERE)
    assert poses.shape == (5, 4, 4)
    assert np.isfinite(poses).all()


def test_nothing_solid_cannot_be_looked_at() -> None:
    with pytest.raises(ValueError, match="nothing in the map is solid"):
        random_poses(np.empty((0, 3)), 5, np.random.default_rng(0), ANYWHERE)


def test_a_few_outliers_do_not_make_a_map_larger() -> None:
    outliers = np.full((2, 3), [[1e4], [-1e4]])
    assert radius(np.concatenate([CLOUD, outliers])) == pytest.approx(radius(CLOUD), rel=0.1)


def test_cells_are_as_large_as_they_are_far() -> None:
    grid = np.column_stack([*(axis.ravel() for axis in np.mgrid[-1:1:40j, -1:1:40j]), np.full(1600, 4.0)])
    near, far = (cells(scale * grid, np.zeros(3)) for scale in (1.0, 16.0))
    assert len(near) == len(far)


def test_cells_differ_by_side_and_distance() -> None:
    point = np.array([[0.1, 0.2, 0.3]])
    seen_from = [cells(point, point[0] + offset) for offset in ([1, 0, 0], [-1, 0, 0], [4, 0, 0], [1.01, 0, 0])]
    assert seen_from[0] == seen_from[3]
    assert not seen_from[0] & seen_from[1]
    assert not seen_from[0] & seen_from[2]


def wall(depth: float, spread: float = 0.0, alpha: float = 1.0) -> Render:
    """The render of a wall across the view of the small camera, `depth` away."""
    shape = (small_camera().height, small_camera().width)
    depths, spreads, alphas = (np.full(shape, value, np.float32) for value in (depth, spread, alpha))
    return Render(np.zeros((*shape, 3), np.float32), depths, depths, spreads, alphas)


@given(depth=st.floats(0.5, 50.0))
def test_a_view_of_a_wall_shows_the_cells_of_the_wall(depth: float) -> None:
    camera = small_camera()
    found = seen_cells(wall(depth), camera, POSE, near=0.1)
    columns, rows = np.meshgrid(np.arange(2, camera.width, 4), np.arange(2, camera.height, 4))
    rays = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    assert found == cells(transform(POSE, np.float32(depth) * rays), POSE[:3, 3]) != set()


@pytest.mark.parametrize(
    "render",
    [wall(0.05), wall(2.0, spread=1.0), wall(2.0, alpha=0.5), wall(np.nan)],
    ids=["near", "haze", "thin", "none"],
)
def test_a_view_of_nothing_distinct_shows_nothing(render: Render) -> None:
    assert seen_cells(render, small_camera(), POSE, near=0.1) == set()


@pytest.mark.parametrize("pixel", [(7.5, 5.5), (2.0, 9.0)], ids=["ahead", "aside"])
def test_what_is_aimed_at_is_seen_unless_something_is_before_it(pixel) -> None:
    camera = small_camera(16, 12)

    def seen(depth: float, distance: float) -> bool:
        target = transform(POSE, distance * camera.rays(np.array([pixel])))[0]
        return sees(wall(depth), camera, POSE, target)

    assert seen(2.0, 2.1)
    assert not seen(2.0, 4.0)
    assert not seen(4.0, 2.0)
    assert not seen(np.nan, 2.0)
    assert not seen(2.0, -2.0)


def test_what_is_beside_the_picture_is_not_seen() -> None:
    camera = small_camera(16, 12)
    target = transform(POSE, 2.0 * camera.rays(np.array([[20.0, 5.0]])))[0]
    assert not sees(wall(2.0), camera, POSE, target)
