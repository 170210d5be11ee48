"""Fixtures that tests share: a simulated room, its map and its photos."""

from __future__ import annotations

import importlib
import os
from pathlib import Path

# Before a test imports torch, as the package sets it for the renderers and matchers that it makes: threads of OpenMP
# that wait by spinning take ten times as long on a machine that does something else as well.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# isort: split

import numpy as np
import pytest
from hypothesis import settings

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.simulate import Room, SimulatedPhoto, cover, simulate_photos

# A slow, shared machine is no reason to fail.
settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")

# Nodes of another run on this machine, or of a robot on its network, must not be heard.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


def pytest_configure(config: pytest.Config) -> None:
    """Let the ROS wheels start Python again, with their library path, before a test imports them.

    Started again later, pytest would write to the file in which it captures the output instead of the terminal.
    """
    if importlib.util.find_spec("ros_wheels_bootstrapper") and "_ROS_WHEELS_BOOTSTRAP_COMPLETE" not in os.environ:
        config.pluginmanager.getplugin("capturemanager").stop_global_capturing()
        importlib.import_module("ros_wheels_bootstrapper")


@pytest.fixture(scope="session")
def room() -> Room:
    return Room(seed=0)


@pytest.fixture(scope="session")
def room_map(room: Room) -> GaussianMap:
    return cover(room)


@pytest.fixture(scope="session")
def room_map_file(room_map: GaussianMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "room.ply"
    write_ply(path, room_map)
    return path


@pytest.fixture(scope="session")
def room_camera() -> Camera:
    """A camera with the barrel distortion of a cheap lens."""
    K = [[500.0, 0.0, 322.0], [0.0, 502.0, 236.0], [0.0, 0.0, 1.0]]
    return Camera(640, 480, np.array(K), np.array([-0.28, 0.09, 0.0008, -0.0005, 0.0]))


@pytest.fixture(scope="session")
def room_photos(room: Room, room_camera: Camera) -> list[SimulatedPhoto]:
    return simulate_photos(room, room_camera, count=8, seed=0)


@pytest.fixture
def photo(room_photos: list[SimulatedPhoto]) -> SimulatedPhoto:
    return room_photos[0]


@pytest.fixture
def tf(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a localizer that is started find tf2_ros: where none is installed, the stand-in."""
    stand_in = str(Path(__file__).parent / "support" / "tf2_stand_in")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([os.environ.get("PYTHONPATH", ""), stand_in]))


# What talks to ROS is imported in here: see pytest_configure.


@pytest.fixture(scope="module")
def localizer(room_map_file: Path):
    """The installed localizer, ready, with the map of the room; one for all tests of a file."""
    from node_harness import running_localizer

    with running_localizer(map__path=room_map_file) as process:
        yield process


@pytest.fixture
def client(localizer):
    """A camera and a robot that have found the localizer."""
    from node_harness import connected_client

    with connected_client() as client:
        yield client
