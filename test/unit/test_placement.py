"""Where a map is looked at from."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import small_camera

from gsfeatloc_ros.common.geometry import make_pose, so3_exp, transform
from gsfeatloc_ros.index.placement import cells, cover, radius, random_poses, seen_cells
from gsfeatloc_ros.render import Render

POSE = make_pose(so3_exp(np.array([0.3, -0.2, 1.0])), np.array([1.0, 2.0, 3.0]))
CLOUD = np.random.default_rng(0).uniform([-3, -2, 0], [3, 2, 1], (500, 3))


def shown(views: list[set[int]], chosen: list[int]) -> int:
    return len(set().union(*(views[view] for view in chosen)))


some_views = st.lists(st.sets(st.integers(0, 12), max_size=6), max_size=7)


@given(views=some_views, count=st.integers(0, 4))
def test_chosen_views_show_nearly_as_much_as_the_best_choice(views, count) -> None:
    chosen = cover(views, count)
    assert len(chosen) == len(set(chosen)) <= count
    best = max(
        shown(views, list(choice)) for choice in itertools.combinations(range(len(views)), min(count, len(views)))
    )
    assert best >= shown(views, chosen) >= (1 - 1 / math.e) * best


@given(views=some_views, count=st.integers(0, 4))
def test_each_chosen_view_shows_most_of_what_those_before_do_not(views, count) -> None:
    covered: set[int] = set()
    for view in cover(views, count):
        gain = len(views[view] - covered)
        assert gain == max(len(other - covered) for other in views) > 0
        covered |= views[view]


@given(views=some_views, count=st.integers(0, 4), data=st.data())
def test_others_are_chosen_only_when_the_first_show_nothing_more(views, count, data) -> None:
    first = data.draw(st.integers(0, len(views)))
    chosen = cover(views, count, first)
    preferred = cover(views[:first], count)
    assert chosen[: len(preferred)] == preferred
    assert all(view >= first for view in chosen[len(preferred) :])


def test_nothing_is_chosen_of_nothing() -> None:
    assert cover([], 5) == []
    assert cover([set(), set()], 5) == []


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), shift=st.floats(-1e3, 1e3), scale=st.floats(1e-3, 1e3))
def test_random_poses_aim_at_a_point(seed: int, shift: float, scale: float) -> None:
    points = shift + scale * CLOUD
    for pose in random_poses(points, 20, np.random.default_rng(seed)):
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(pose[:3, :3]) > 0
        seen = (points - pose[:3, 3]) @ pose[:3, :3]
        off_axis = np.linalg.norm(seen[:, :2], axis=1)
        assert (off_axis[seen[:, 2] > 0] < 1e-6 * (abs(shift) + scale)).any()


def test_random_poses_lie_inside_and_around() -> None:
    positions = random_poses(CLOUD, 400, np.random.default_rng(0))[:, :3, 3]
    inside = ((positions > CLOUD.min(axis=0)) & (positions < CLOUD.max(axis=0))).all(axis=1)
    assert 0.2 < inside.mean() < 0.8
    distances = np.linalg.norm(positions[:, None] - CLOUD, axis=2).min(axis=1)
    assert distances.max() < 2.5 * radius(CLOUD)


def test_the_same_seed_gives_the_same_poses() -> None:
    a, b, c = (random_poses(CLOUD, 10, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.allclose(a, c)


def test_a_single_point_is_looked_at() -> None:
    poses = random_poses(np.ones((1, 3)), 5, np.random.default_rng(0))
    assert poses.shape == (5, 4, 4)
    assert np.isfinite(poses).all()


def test_nothing_solid_cannot_be_looked_at() -> None:
    with pytest.raises(ValueError, match="nothing in the map is solid"):
        random_poses(np.empty((0, 3)), 5, np.random.default_rng(0))


def test_a_few_outliers_do_not_make_a_map_larger() -> None:
    outliers = np.full((2, 3), [[1e4], [-1e4]])
    assert radius(np.concatenate([CLOUD, outliers])) == pytest.approx(radius(CLOUD), rel=0.1)


def test_cells_are_as_large_as_they_are_far() -> None:
    grid = np.column_stack([*(axis.ravel() for axis in np.mgrid[-1:1:40j, -1:1:40j]), np.full(1600, 4.0)])
    near, far = (cells(scale * grid, np.zeros(3), 0.25) for scale in (1.0, 16.0))
    assert len(near) == len(far)
    assert len(cells(grid, np.zeros(3), 0.125)) > 2 * len(near)


def test_cells_differ_by_side_and_distance() -> None:
    point = np.array([[0.1, 0.2, 0.3]])
    seen_from = [cells(point, point[0] + offset, 0.25) for offset in ([1, 0, 0], [-1, 0, 0], [4, 0, 0], [1.01, 0, 0])]
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
    assert found == cells(transform(POSE, np.float32(depth) * rays), POSE[:3, 3], 0.25) != set()


@pytest.mark.parametrize(
    "render",
    [wall(0.05), wall(2.0, spread=1.0), wall(2.0, alpha=0.5), wall(np.nan)],
    ids=["near", "haze", "thin", "none"],
)
def test_a_view_of_nothing_distinct_shows_nothing(render: Render) -> None:
    assert seen_cells(render, small_camera(), POSE, near=0.1) == set()
