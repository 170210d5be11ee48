"""A simulated room: its photos, its Gaussian Splatting map and its bag, for the demo and the tests."""

from gsfeatloc_ros.simulate.bag import write_bag
from gsfeatloc_ros.simulate.photos import SimulatedPhoto, simulate_photos
from gsfeatloc_ros.simulate.room import RayTrace, Room
from gsfeatloc_ros.simulate.room_map import cover

__all__ = ["RayTrace", "Room", "SimulatedPhoto", "cover", "simulate_photos", "write_bag"]
