"""The installed localizer shows its map to those who look at it."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import OccupancyGrid
from node_harness import connected_client, running_localizer
from sensor_msgs.msg import PointCloud2

from gsfeatloc_ros.node.qos import LAST


def test_the_map_as_points_and_as_a_grid_for_subscribers(room_map_file):
    aligned = {"map__aligned": True, "map__cloud_points": 5000, "index__build": False}
    with running_localizer(map__path=room_map_file, **aligned) as process, connected_client() as client:
        clouds: list[PointCloud2] = []
        grids: list[OccupancyGrid] = []
        client.node.create_subscription(PointCloud2, "localizer/map", clouds.append, LAST)
        client.node.create_subscription(OccupancyGrid, "localizer/occupancy", grids.append, LAST)
        assert client.spin_until(lambda: bool(clouds and grids)), process.output
        cloud, grid = clouds[0], grids[0]
        assert (cloud.header.frame_id, cloud.width, cloud.point_step) == ("map", 5000, 16)
        assert [field.name for field in cloud.fields] == ["x", "y", "z", "rgb"]
        points = np.frombuffer(bytes(cloud.data), np.float32).reshape(-1, 4)[:, :3]
        assert np.all(np.abs(points) < [3.1, 2.6, 3.1])  # of the room
        cells = np.array(grid.data, np.int8).reshape(grid.info.height, grid.info.width)
        assert set(np.unique(cells)) <= {-1, 0, 100}
        assert (cells == 0).mean() > 0.5
        # Kept for those who come later; made once.
        late: list[PointCloud2] = []
        client.node.create_subscription(PointCloud2, "localizer/map", late.append, LAST)
        assert client.spin_until(lambda: bool(late)), process.output
        client.spin(1.5)
        assert (len(clouds), len(grids)) == (1, 1)


def test_of_a_map_that_nobody_aligned_there_is_no_grid(localizer, client):
    assert client.node.count_publishers("localizer/occupancy") == 0
    assert client.node.count_publishers("localizer/map") == 1
