"""The building that large maps are measured on."""

from __future__ import annotations

import numpy as np
import pytest

from gsfeatloc_ros.benchmark.building import measure_buildings
from gsfeatloc_ros.benchmark.frames import pinhole
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.maps.ply import write_ply_parts
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.simulate.building import Building

ARRAYS = ("means", "scales", "rotations", "opacities", "sh")


def test_no_room_has_no_parts() -> None:
    assert not list(Building(0).parts())


def test_a_larger_building_has_the_same_rooms_and_more() -> None:
    small, large = (list(Building(rooms).parts(500, sh_degree=1)) for rooms in (2, 12))
    assert len(large) == 12
    for one, other in zip(small, large, strict=False):
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert not np.array_equal(large[2].sh, large[3].sh)
    # The eleventh room is the first of the second storey.
    assert large[10].means[:, 2].min() > 2.5


def test_parts_written_one_after_another_are_one_map(tmp_path) -> None:
    parts = list(Building(3).parts(700))
    write_ply_parts(tmp_path / "map.ply", Building(3).parts(700), 3 * 700)
    read = load_map(tmp_path / "map.ply")
    np.testing.assert_array_equal(read.means, np.concatenate([part.means for part in parts]))
    np.testing.assert_allclose(read.opacities, np.concatenate([part.opacities for part in parts]), atol=1e-6)


def test_a_storey_is_its_rooms() -> None:
    building = Building(12)
    storey = building.storey(1, 500)
    np.testing.assert_array_equal(storey.means[500:], building.part(11, 500).means)
    assert len(storey) == 1000
    assert len(building.storey(0, 500)) == 5000


def test_cameras_in_a_room_see_its_walls() -> None:
    building = Building(1)
    renderer = create_renderer(building.part(0, 20_000), "cpu")
    for pose in [building.pose(0, seed) for seed in range(4)]:
        render = renderer.render(pinhole((80, 60)), pose)
        assert render.alpha.mean() > 0.9
        assert 0.3 < np.nanmedian(render.median_depth) < 6.0


@pytest.mark.nightly
def test_measures_of_a_building_are_there(tmp_path) -> None:
    (row,) = measure_buildings([2], tmp_path, room_gaussians=50_000)
    assert row["gaussians"] == 100_000
    assert row["localized"] == 12
    assert 0 < row["frames"]["min"] <= row["frames"]["median"] < row["queries"]["median"]
    assert row["second"]["anonymous_mb"] > 50
