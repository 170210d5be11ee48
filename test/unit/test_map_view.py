"""A map as points and as a grid, for those who look at it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsfeatloc_ros.common.geometry import so3_exp
from gsfeatloc_ros.maps.cloud import point_cloud
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.maps.occupancy import FREE, OCCUPIED, UNKNOWN, Slice, occupancy
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


def test_a_slice_without_height_is_refused():
    with pytest.raises(ValueError, match=r"map\.occupancy_max_height is 0\.1: it must be above"):
        Slice(0.1, 0.1, 0.05)
