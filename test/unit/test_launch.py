"""The launch files: what they make of their arguments, with launch and launch_ros where these are installed."""

from __future__ import annotations

import importlib.util
import runpy
from collections.abc import ItemsView
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import launch_stand_in
import pytest
from launch_stand_in import (
    ExecuteProcess,
    FindPackageShare,
    IncludeLaunchDescription,
    LaunchConfiguration,
    LaunchContext,
    Node,
    OpaqueFunction,
    ParameterValue,
    PathJoinSubstitution,
    ProcessIO,
    RegisterEventHandler,
    Shutdown,
)

ROOT = Path(__file__).parents[2]
HAS_LAUNCH = importlib.util.find_spec("launch_ros") is not None


def load(name: str) -> SimpleNamespace:
    """Run a launch file; return what it defines, and what it generates as `description`."""
    module = SimpleNamespace(**runpy.run_path(str(ROOT / "launch" / f"{name}.launch.py")))
    module.description = module.generate_launch_description()
    return module


def arguments(name: str) -> dict[str, object]:
    """Return the default values of the arguments by name; None where one has to be given."""
    return {argument.name: argument.default_value for argument in declared(name)}


def declared(name: str) -> list:
    """Return the declarations of arguments, real ones or stand-ins."""
    return [made for made in load(name).description.entities if type(made).__name__ == "DeclareLaunchArgument"]


@pytest.fixture
def stand_in(monkeypatch):
    launch_stand_in.install(monkeypatch)


@pytest.fixture(params=["stand-in", "installed"])
def any_launch(request, monkeypatch):
    if request.param == "stand-in":
        launch_stand_in.install(monkeypatch)
    elif not HAS_LAUNCH:
        pytest.skip("launch_ros is not installed: it is in a ROS install only, not among the wheels")


def made(name: str, kind: type) -> list:
    return [entity for entity in load(name).description.entities if isinstance(entity, kind)]


def test_arguments_of_the_localizer(any_launch):
    given = arguments("localizer")
    launch = load("localizer")
    others = ["map", "params_file", "namespace", "transport", "use_sim_time", "camera_info"]
    assert list(given) == [*others, *launch.INPUTS, *launch.OUTPUTS]
    assert [name for name, default in given.items() if default is None] == ["map"]


def test_arguments_of_replay(any_launch):
    given = arguments("replay")
    assert list(given) == ["bag", "map", "rate"]
    assert [name for name, default in given.items() if default is None] == ["bag", "map"]


def test_every_argument_is_described(any_launch):
    for name in ("localizer", "replay"):
        assert all(argument.description for argument in declared(name))


def test_topics_are_those_of_the_node(any_launch):
    profile = list(ElementTree.parse(ROOT / "config/localizer.policy.xml").getroot().iter("topics"))
    subscribed, published = (
        {topic.text for group in profile if group.get(way) for topic in group} for way in ("subscribe", "publish")
    )
    launch = load("localizer")
    of_others = {"image/compressed", "/tf", "/tf_static", "/clock"}
    assert {"camera_info", *launch.INPUTS} == subscribed - of_others
    assert set(launch.OUTPUTS) == {topic for topic in published if topic[0] not in "/~"}


def started(**given: str) -> Node:
    """Return the node that the localizer's launch file makes of arguments."""
    (made_by,) = made("localizer", OpaqueFunction)
    defaults = {name: default for name, default in arguments("localizer").items() if isinstance(default, str)}
    (node,) = made_by.function(LaunchContext(defaults | {"map": "5", "params_file": "a.yaml"} | given))
    return node


def test_the_localizer_is_started_with_its_parameters_and_topics(stand_in):
    node = started(namespace="robot", odom="/odom")
    assert (node.package, node.executable, node.name) == ("gsfeatloc_ros", "localizer", "localizer")
    assert node.namespace == "robot"
    launch = load("localizer")
    expected = {topic: topic for topic in ("camera_info", *launch.INPUTS, *launch.OUTPUTS)} | {"odom": "/odom"}
    assert dict(node.remappings) == expected
    # The map that is named is the one that is loaded; what else the file says stays.
    path = ParameterValue("5", value_type=str)
    assert node.parameters == ["a.yaml", {"map.path": path, "use_sim_time": False}]
    node = started(transport="compressed", use_sim_time="true")
    assert node.parameters[1] == {"map.path": path, "use_sim_time": True, "image.transport": "compressed"}


@pytest.mark.parametrize(
    ("image", "camera_info", "expected"),
    [
        ("/camera/image_raw", "", "/camera/camera_info"),
        ("/left/camera/color/image_raw", "", "/left/camera/color/camera_info"),
        ("camera/image_raw", "", "camera/camera_info"),
        ("/image_raw", "", "/camera_info"),
        ("image", "", "camera_info"),
        ("/camera/image_raw", "/info", "/info"),
    ],
)
def test_camera_info_is_the_one_beside_the_image(stand_in, image, camera_info, expected):
    assert dict(started(image=image, camera_info=camera_info).remappings)["camera_info"] == expected


def test_the_default_parameters_are_the_packages(stand_in):
    path = arguments("localizer")["params_file"]
    package, *parts = path.substitutions
    assert package == FindPackageShare("gsfeatloc_ros")
    assert ROOT.joinpath(*parts).is_file()


def test_replay_starts_the_localizer_on_the_map_and_the_clock_of_the_bag(stand_in):
    (included,) = made("replay", IncludeLaunchDescription)
    package, *parts = included.launch_description_source.substitutions
    assert isinstance(included.launch_description_source, PathJoinSubstitution)
    assert package == FindPackageShare("gsfeatloc_ros")
    assert ROOT.joinpath(*parts) == ROOT / "launch" / "localizer.launch.py"
    assert dict(included.launch_arguments) == {"map": LaunchConfiguration("map"), "use_sim_time": "true"}


def test_replay_plays_the_bag_once_the_localizer_is_ready(stand_in):
    (registered,) = made("replay", RegisterEventHandler)
    handler = registered.event_handler
    assert handler.on_stdout is handler.on_stderr
    assert handler.on_stdout(ProcessIO(text=b"[INFO] [1.2] [localizer]: loading room.ply")) == []
    (play,) = handler.on_stderr(ProcessIO(text=b"[INFO] [1.2] [localizer]: ready, 250731 Gaussians"))
    assert isinstance(play, ExecuteProcess)
    words = ["ros2", "bag", "play", LaunchConfiguration("bag"), "--clock", "--rate", LaunchConfiguration("rate")]
    assert play.cmd == words
    assert isinstance(play.on_exit, Shutdown)
    # A change of the map makes it ready again.
    assert handler.on_stdout(ProcessIO(text=b"[INFO] [2.3] [localizer]: ready, 3 Gaussians")) == []


def test_arguments_are_those_that_are_used(stand_in):
    (registered,) = made("replay", RegisterEventHandler)
    played = registered.event_handler.on_stdout(ProcessIO(text=b"[localizer]: ready"))
    used = set(configurations([*load("replay").description.entities, *played]))
    assert used == set(arguments("replay"))


def configurations(value: object) -> list[str]:
    """Return the names of all launch configurations in what was made."""
    if isinstance(value, LaunchConfiguration):
        return [value.variable_name]
    if hasattr(value, "__dataclass_fields__"):
        value = list(vars(value).values())
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple | ItemsView):
        return [name for part in value for name in configurations(part)]
    return []
