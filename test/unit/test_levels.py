"""Coarser levels of large maps: what merged Gaussians are, and which chunks a view is drawn from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import psnr, small_camera

from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.maps import GaussianMap
from gsfeatloc_ros.maps.assemble import SH_C0
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.render.camera_view import camera_view, visible_chunks
from gsfeatloc_ros.render.chunks import BRANCHING, COV_XX, LOG2_OPACITY, MEAN_X, PreparedMap, level_starts
from gsfeatloc_ros.render.cut import Cut
from gsfeatloc_ros.render.levels import MAX_SIZE
from gsfeatloc_ros.render.prepare import prepare
from gsfeatloc_ros.simulate.two_rooms import VIEWS, two_rooms

COUNT = 40_000


@pytest.fixture(scope="module")
def rooms() -> GaussianMap:
    return two_rooms(COUNT)


@pytest.fixture(scope="module")
def large(rooms) -> PreparedMap:
    """The map as if it were a large one."""
    return prepare(rooms, large=0)


def away(units: float) -> np.ndarray:
    """A pose from which the two rooms are seen from above, so far away."""
    return make_pose(so3_exp(np.array([np.pi, 0, 0])), np.array([5.0, 2.0, units]))


@pytest.mark.parametrize(
    ("leaves", "starts"), [(0, [0, 0]), (1, [0, 1]), (4, [0, 4, 5]), (5, [0, 5, 7, 8]), (17, [0, 17, 22, 24, 25])]
)
def test_each_level_has_a_chunk_for_four_of_the_level_before(leaves: int, starts: list[int]) -> None:
    assert level_starts(leaves, coarser=True).tolist() == starts
    assert level_starts(leaves, coarser=False).tolist() == [0, leaves]


@pytest.mark.parametrize("count", [0, 1, 257])
def test_the_smallest_maps_may_have_levels(count: int) -> None:
    few = two_rooms(1000)
    few = replace(few, **{n: getattr(few, n)[:count] for n in ("means", "scales", "rotations", "opacities", "sh")})
    assert np.isfinite(create_renderer(prepare(few, large=0)).render(small_camera(), away(500.0)).rgb).all()


def test_a_near_view_of_a_large_map_is_drawn_to_the_last_bit_as_ever(rooms, large) -> None:
    exact = prepare(rooms)
    assert len(exact.sizes) == exact.leaves == large.leaves < len(large.sizes)
    for pose in VIEWS.values():
        a, b = (create_renderer(m).render(small_camera(640, 480), pose) for m in (exact, large))
        for name in ("rgb", "depth", "median_depth", "depth_std", "alpha"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("units", [20.0, 60.0])
def test_a_far_view_is_nearly_the_same_from_fewer_chunks(rooms, units: float, antialiased: bool) -> None:
    exact, large = (prepare(replace(rooms, antialiased=antialiased), large=n) for n in (COUNT, 0))
    camera, pose = small_camera(), away(units)
    view = camera_view(camera, pose)
    assert len(Cut(large).chunks(view)) < 0.6 * len(Cut(exact).chunks(view))
    fine, coarse = (create_renderer(m).render(camera, pose) for m in (exact, large))
    assert psnr(coarse, fine) > 30
    assert abs(coarse.alpha.mean() - fine.alpha.mean()) < 0.15 * fine.alpha.mean()
    both = np.isfinite(fine.depth) & np.isfinite(coarse.depth)
    # The depth of what lies within a pixel may be that of any part of it: that is what the spread says.
    error = np.abs(coarse.median_depth - fine.median_depth)[both]
    assert np.median(error / units) < 0.01
    assert np.mean(error <= 3 * np.maximum(coarse.depth_std, 0.002 * units)[both]) > 0.95


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), log_distance=st.floats(-1, 3))
def test_all_that_a_view_may_see_is_in_its_chunks_once(large, seed: int, log_distance: float) -> None:
    rng = np.random.default_rng(seed)
    rotation = so3_exp(rng.normal(size=3))
    pose = make_pose(rotation, np.array([5.0, 2.0, 1.3]) - rotation[:, 2] * 10**log_distance)
    view = camera_view(small_camera(), pose)
    chosen = Cut(large).chunks(view)
    starts = large.level_starts
    leaves = []
    for chunk in chosen:
        level = int(np.searchsorted(starts, chunk, side="right")) - 1
        place, width = chunk - starts[level], BRANCHING**level
        leaves += range(place * width, min((place + 1) * width, large.leaves))
    assert leaves == sorted(set(leaves))
    assert set(visible_chunks(view, large.low[: large.leaves], large.high[: large.leaves])) <= set(leaves)


@pytest.mark.parametrize("max_chunks", [1, 20, 60, 1000])
def test_a_view_is_drawn_from_no_more_chunks_than_allowed(large, max_chunks: int) -> None:
    for pose in (*VIEWS.values(), away(8.0)):
        view = camera_view(small_camera(640, 480), pose)
        chunks = Cut(large, max_chunks).chunks(view)
        assert 1 <= len(chunks) <= max_chunks
        if len(exact := Cut(large).chunks(view)) <= max_chunks:
            np.testing.assert_array_equal(chunks, exact)


def clusters(opacity: float, spread: float) -> tuple[GaussianMap, np.ndarray]:
    """Gaussians in 75 clusters of four, 10 units apart, and their means (75, 4, 3)."""
    rng = np.random.default_rng(0)
    means = np.arange(75.0)[:, None, None] * [10.0, 0, 0] + spread * rng.normal(size=(75, 4, 3))
    return GaussianMap(
        means=means.reshape(-1, 3).astype(np.float32),
        scales=np.full((300, 3), 0.1, np.float32),
        rotations=np.tile(np.float32([1, 0, 0, 0]), (300, 1)),
        opacities=np.full(300, opacity, np.float32),
        sh=rng.uniform(-1, 1, (300, 1, 3)).astype(np.float32),
    ), means


def test_a_merged_gaussian_has_the_moments_and_the_colour_of_the_four_it_stands_for() -> None:
    gaussian_map, means = clusters(0.5, 0.2)
    merged = prepare(gaussian_map, large=0)
    rows = merged.gaussians[merged.leaves]
    there = rows[LOG2_OPACITY] > -np.inf
    assert there.sum() == 75
    np.testing.assert_allclose(rows[MEAN_X : MEAN_X + 3, there].T, means.mean(axis=1), atol=1e-4)
    expected = [np.cov(four.T, bias=True)[np.triu_indices(3)] + 0.01 * np.eye(3)[np.triu_indices(3)] for four in means]
    np.testing.assert_allclose(rows[COV_XX : COV_XX + 6, there].T, expected, atol=1e-4)
    colours = gaussian_map.sh.reshape(75, 4, 3).mean(axis=1)
    np.testing.assert_allclose(merged.sh[merged.leaves][:, there].T, colours, atol=2e-3)
    size = np.sqrt(np.mean([0.5 * (e[0] + e[3] + e[5]) for e in np.array(expected)]))
    np.testing.assert_allclose(merged.sizes[merged.leaves], size, rtol=1e-4)


@pytest.mark.parametrize("opacity", [0.02, 0.3, 0.9])
@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_a_merged_gaussian_covers_as_much_as_the_four_where_it_is_drawn(opacity: float, spread: float) -> None:
    """Where light is lost one by one, what adds up is the logarithm of the transmittance."""
    gaussian_map, _ = clusters(opacity, spread)
    gaussian_map = replace(gaussian_map, sh=np.full_like(gaussian_map.sh, 0.5 / SH_C0))
    exact, large = prepare(gaussian_map), prepare(gaussian_map, large=0)
    camera = small_camera(400, 60)
    pose = make_pose(np.eye(3), np.array([370.0, 0.0, -70.0 * large.sizes[-1] / (0.75 * MAX_SIZE)]))
    coarse = replace(large, gaussians=large.gaussians.copy())
    coarse.gaussians[: large.leaves, LOG2_OPACITY] = -np.inf
    fine, merged = (create_renderer(m).render(camera, pose).alpha.astype(np.float64) for m in (exact, coarse))
    depths = [-np.log1p(-np.minimum(alpha, 0.999)).sum() for alpha in (fine, merged)]
    assert depths[0] > 1
    assert 0.8 < depths[1] / depths[0] < 1.25


def test_where_there_is_something_solid_a_large_map_says_as_well(rooms, large) -> None:
    exact = prepare(rooms)
    np.testing.assert_array_equal(large.solid_points(1000), exact.solid_points(1000))


def test_the_gaussians_of_a_large_map_one_by_one_are_those_of_its_finest_level(rooms, large) -> None:
    np.testing.assert_array_equal(large.unpacked(3).means, prepare(rooms).unpacked(3).means)


def test_levels_do_not_depend_on_the_number_of_threads(rooms, large) -> None:
    again = prepare(rooms, large=0)
    for name in ("gaussians", "sh", "low", "high", "sizes"):
        assert getattr(again, name).tobytes() == getattr(large, name).tobytes()
