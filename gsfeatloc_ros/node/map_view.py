"""The map for those who look at it: ~/map as points, ~/occupancy as a grid, both made for subscribers alone."""

from __future__ import annotations

import threading
from functools import partial

from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gsfeatloc_ros.common.threads import Cores
from gsfeatloc_ros.common.words import in_one_line
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.maps import GaussianMap, look_through
from gsfeatloc_ros.maps.cloud import CloudMaker
from gsfeatloc_ros.maps.occupancy import OccupancyMaker, Slice
from gsfeatloc_ros.node.diagnostics import Reporter
from gsfeatloc_ros.node.encode import cloud_message, occupancy_message
from gsfeatloc_ros.node.qos import LAST, overridable


class MapView:
    """Publishes what the map looks like, once somebody subscribes; the map's file is read again for it,
    part by part.

    All but the making runs in the executor's thread.

    Args:
        node: whose topics they are.
        settings: of the map.
        reporter: writes to the log.
        cores: on which they are made, beside all else.

    Raises:
        ValueError: the slice of ~/occupancy has no height.
    """

    def __init__(self, node: Node, settings: MapSettings, reporter: Reporter, cores: Cores) -> None:
        self._node, self._settings, self._reporter, self._cores = node, settings, reporter, cores
        self._slice = Slice(settings.occupancy_min_height, settings.occupancy_max_height, settings.occupancy_resolution)
        publisher = partial(node.create_publisher, qos_profile=LAST, qos_overriding_options=overridable())
        self._cloud = publisher(PointCloud2, "~/map") if settings.cloud_points else None
        # Where up is, and the floor, nobody knows of a map that is not aligned.
        self._occupancy = publisher(OccupancyGrid, "~/occupancy") if settings.aligned else None
        # Those on which something was published of the map in use, or is about to be.
        self._made: set[Publisher] = set()

    def use_map(self, settings: MapSettings) -> None:
        """Go on with another map."""
        self._settings = settings
        self._made = set()

    def look(self) -> None:
        """Begin to make what somebody subscribes to by now, and was not made yet."""
        wanted = [
            publisher
            for publisher in (self._cloud, self._occupancy)
            if publisher is not None and publisher not in self._made and publisher.get_subscription_count() > 0
        ]
        if wanted:
            self._made.update(wanted)
            arguments = (wanted, self._settings)
            threading.Thread(target=self._make, args=arguments, name="map view", daemon=True).start()

    def close(self) -> None:
        """Publish nothing more."""
        for publisher in (self._cloud, self._occupancy):
            if publisher is not None:
                self._node.destroy_publisher(publisher)
        self._cloud = self._occupancy = None
        self._made = set()

    # In a thread of its own.

    def _make(self, wanted: list[Publisher], settings: MapSettings) -> None:
        with self._cores.in_background():
            self._publish(wanted, settings)

    def _publish(self, wanted: list[Publisher], settings: MapSettings) -> None:
        try:
            cloud, grid = CloudMaker(settings.cloud_points), OccupancyMaker(self._slice)

            def look(part: GaussianMap) -> None:
                if self._cloud in wanted:
                    cloud.add(part)
                if self._occupancy in wanted:
                    grid.add(part)

            look_through(settings.path, look, settings.alignment(), settings.reading)
            header = Header(stamp=self._node.get_clock().now().to_msg(), frame_id=settings.frame_id)
            for publisher in wanted:
                if publisher is self._cloud:
                    message = cloud_message(cloud.cloud(), header)
                else:
                    message = occupancy_message(grid.grid(), header)
                # Another map may have come meanwhile, or the end.
                if publisher in (self._cloud, self._occupancy) and settings.path == self._settings.path:
                    publisher.publish(message)
        except Exception as error:  # whatever it is, it is for people to look at, no more
            self._reporter.say(f"the map cannot be shown: {in_one_line(error)}")
