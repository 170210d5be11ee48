"""A map as points and as a grid, for those who look at it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsfeatloc_ros.common.geometry import so3_exp
from gsfeatloc_ros.maps import assemble, load_map, look_through
from gsfeatloc_ros.maps import occupancy as occupancy_module
from gsfeatloc_ros.maps.cloud import CloudMaker, PointCloud
from gsfeatloc_ros.maps.gaussian_map import GaussianMap, MapError
from gsfeatloc_ros.maps.occupancy import FREE, OCCUPIED, UNKNOWN, Occupancy, OccupancyMaker, Slice
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.maps.similarity import Similarity

SLICE = Slice(0.1, 1.0, 0.05)


def made(means, scales=(0.02, 0.02, 0.001), opacities=0.9) -> GaussianMap:
    """Gaussians of level 0.75 in red, without a turn."""
    count = len(means)
    sh = np.zeros((count, 1, 3), np.float32)
    sh[:, 0, 0] = 0.25 / 0.28209479177387814
    return GaussianMap(
        np.array(means, np.float32).reshape(count, 3),
        np.broadcast_to(np.float32(scales), (count, 3)),
        np.broadcast_to(np.float32([1, 0, 0, 0]), (count, 4)),
        np.broadcast_to(np.float32(opacities), count),
        sh,
    )


def point_cloud(gaussian_map: GaussianMap, count: int) -> PointCloud:
    maker = CloudMaker(count)
    maker.add(gaussian_map)
    return maker.cloud()


def occupancy(gaussian_map: GaussianMap, slice_: Slice) -> Occupancy:
    maker = OccupancyMaker(slice_)
    maker.add(gaussian_map)
    return maker.grid()


@pytest.mark.parametrize("count", [0, 1])
def test_an_empty_map_has_no_points_and_no_cells(count):
    assert point_cloud(made([]), count).points.shape == (0, 3)
    assert occupancy(made([]), SLICE).cells.shape == (0, 0)


def test_the_points_are_the_largest_and_most_solid_ones_where_they_are_in_the_robots_frame():
    gaussian_map = made([[i, 0, 0] for i in range(4)], np.outer([1, 3, 2, 3], [0.1, 0.1, 0.01]), [1.0, 1.0, 1.0, 0.1])
    S_map_splat = Similarity(2.0, so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.0, 0.0, 5.0]))
    cloud = point_cloud(gaussian_map.placed(S_map_splat), 2)
    np.testing.assert_allclose(sorted(cloud.points.tolist()), [[0, 2, 5], [0, 4, 5]], atol=1e-6)
    assert cloud.colours.tolist() == [[191, 128, 128]] * 2


def test_all_points_where_there_are_fewer_than_asked_for():
    assert len(point_cloud(made(np.eye(3)), 100).points) == 3


def test_the_slice_of_the_room_is_its_walls_and_furniture(room, room_map):
    """The truth is the room's solids: what is free by 5 cm at all heights is no obstacle, what is solid by 5 cm is."""
    grid = occupancy(room_map, SLICE)
    rows, columns = np.indices(grid.cells.shape)
    places = grid.origin + (np.column_stack([columns.ravel(), rows.ravel()]) + 0.5) * grid.resolution
    cells = grid.cells.ravel()
    columns_up = [np.column_stack([places, np.full(len(places), z)]) for z in np.arange(0.1, 1.01, 0.05)]
    free = np.all([room.is_free(points, 0.05) for points in columns_up], axis=0)
    assert (cells[free] != OCCUPIED).mean() > 0.995
    # The floor is seen nearly everywhere.
    assert (cells[free] == FREE).mean() > 0.97
    # The outlines of what is solid: cells with something free and something solid within them.
    near = np.any([~room.is_free(points) for points in columns_up], axis=0)
    outline = near & np.any([room.is_free(points, -0.05) for points in columns_up], axis=0)
    inside = np.all(np.abs(places) < [2.95, 2.45], axis=1)
    assert (cells[outline & inside] == OCCUPIED).mean() > 0.9


def test_only_what_is_in_the_slice_and_solid_is_in_the_way():
    one = [[0.5, 0.5, 0.5]]
    assert occupancy(made(one), SLICE).cells.max() == OCCUPIED
    for other in (made(one, opacities=0.3), made([[0.5, 0.5, 1.5]]), made([[0.5, 0.5, -0.5]])):
        assert not (occupancy(other, SLICE).cells == OCCUPIED).any()
    assert set(np.unique(occupancy(made([[0.5, 0.5, 0.05]]), SLICE).cells)) <= {FREE, UNKNOWN}


def test_a_large_gaussian_leaves_no_holes():
    wall = occupancy(made([[0.0, 0.0, 0.5]], (0.6, 0.001, 0.2)), SLICE)
    # 1.8 m long, and a cell or two thick.
    row = wall.cells.max(axis=0) == OCCUPIED
    assert row.sum() * wall.resolution == pytest.approx(1.8, abs=0.15)
    assert np.diff(np.flatnonzero(row)).max() == 1


def test_a_floater_far_away_does_not_make_the_grid_large(room_map):
    means = room_map.means.copy()
    means[0] = [900.0, 900.0, 0.5]
    assert max(occupancy(replace(room_map, means=means), SLICE).cells.shape) < 200


def test_part_by_part_it_is_the_same_however_small_they_are(room_map, tmp_path, monkeypatch):
    """As a map is read that does not fit into memory."""
    factors = np.random.default_rng(0).uniform(0.5, 1.5, (len(room_map), 1)).astype(np.float32)
    path = tmp_path / "map.ply"
    write_ply(path, replace(room_map, scales=factors * room_map.scales))
    turned = Similarity(1.5, so3_exp(np.array([0.0, 0.0, 0.3])), np.array([1.0, 2.0, 0.0]))
    monkeypatch.setattr(assemble, "MAX_PART_ROWS", 2 * assemble.MAX_BLOCK_ROWS)
    monkeypatch.setattr(occupancy_module, "_POINTS_AT_ONCE", 10_000)
    monkeypatch.setattr(occupancy_module, "_MAX_NEW", 100_000)
    cloud, grid, sizes = CloudMaker(2000), OccupancyMaker(SLICE), []

    def look(part: GaussianMap) -> None:
        sizes.append(len(part))
        cloud.add(part)
        grid.add(part)

    look_through(path, look, turned)
    assert max(sizes) <= 2 * assemble.MAX_BLOCK_ROWS
    assert sum(sizes) == len(room_map)
    whole = load_map(path, turned)
    expected = point_cloud(whole, 2000)
    order, expected_order = (np.lexsort(points.T) for points in (cloud.cloud().points, expected.points))
    np.testing.assert_array_equal(cloud.cloud().points[order], expected.points[expected_order])
    np.testing.assert_array_equal(cloud.cloud().colours[order], expected.colours[expected_order])
    np.testing.assert_array_equal(grid.grid().cells, occupancy(whole, SLICE).cells)
    np.testing.assert_array_equal(grid.grid().origin, occupancy(whole, SLICE).origin)


def test_what_is_far_from_the_origin_of_its_file_is_in_its_place_part_by_part(tmp_path):
    far = np.array([1e6, -2e6, 0.0])
    write_ply(tmp_path / "far.ply", replace(made([[0.5, 0.5, 0.5], [1, 2, 0.5]]), S_map_splat=Similarity()))
    places: list[np.ndarray] = []
    look_through(
        tmp_path / "far.ply",
        lambda part: places.append(part.S_map_splat.transform(part.means.astype(np.float64))),
        Similarity(translation=far),
    )
    np.testing.assert_allclose(np.concatenate(places) - far, [[0.5, 0.5, 0.5], [1, 2, 0.5]], atol=1e-6)


def test_a_map_that_cannot_be_used_is_refused_part_by_part(tmp_path):
    gaussian_map = made(np.full((10, 3), np.nan))
    write_ply(tmp_path / "map.ply", gaussian_map)
    with pytest.raises(MapError, match="10 of 10 Gaussians have values that are NaN"):
        look_through(tmp_path / "map.ply", lambda part: None)


def test_a_map_of_which_nothing_can_be_seen_is_refused_part_by_part(tmp_path):
    write_ply(tmp_path / "map.ply", replace(made(np.zeros((10, 3))), opacities=np.full(10, 1e-3, np.float32)))
    with pytest.raises(MapError, match="nothing in it can be seen: none of its 10 Gaussians"):
        look_through(tmp_path / "map.ply", lambda part: None)


def test_a_slice_without_height_is_refused():
    with pytest.raises(ValueError, match=r"map\.occupancy_max_height is 0\.1: it must be above"):
        Slice(0.1, 0.1, 0.05)
