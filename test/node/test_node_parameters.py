"""Parameters in a node: what comes of the command line, and of names that have changed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import rclpy
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from gsfeatloc_ros.node.parameters import declare_parameters, prepare_change, read_settings, with_lists_of_doubles
from gsfeatloc_ros.ros_io.settings import PARAMETERS, Settings

RETIRED = ["localizer.min_inlier_ratio", "localizer.min_correlation", "localizer.min_agreement"]


class Log:
    """The warnings of a node, in place of its logger."""

    def __init__(self, node: Node) -> None:
        self.warnings: list[str] = []
        node.get_logger = lambda: self

    def warning(self, text: str) -> None:
        self.warnings.append(text)


@contextmanager
def node_with(**parameters: object) -> Iterator[Node]:
    """A node of no other purpose; `__` in a name stands for the dot."""
    arguments = ["--ros-args"]
    for name, value in parameters.items():
        arguments += ["-p", f"{name.replace('__', '.')}:={value}"]
    context = rclpy.Context()
    rclpy.init(args=arguments, context=context)
    node = rclpy.create_node("parameters", context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_without_any_given_they_have_their_defaults():
    with node_with() as node:
        assert declare_parameters(node) == Settings()
        assert all(node.has_parameter(parameter.name) for parameter in PARAMETERS)
        assert not any(map(node.has_parameter, RETIRED))


def test_those_given_are_settings():
    with node_with(mode="on_prior", map__translation="[1.0, 2.0, 3.0]", localizer__min_inliers=30) as node:
        settings = declare_parameters(node)
        assert settings.node.mode == "on_prior"
        assert settings.map.translation == (1.0, 2.0, 3.0)
        assert settings.localizer.limits.min_inliers == 30
        assert hash(settings) == hash(read_settings(node))
        node.set_parameters([Parameter("localizer.min_inliers", value=40)])
        assert read_settings(node).localizer.limits.min_inliers == 40
        assert settings.localizer.limits.min_inliers == 30


@pytest.mark.parametrize("name", RETIRED)
@pytest.mark.parametrize("value", ["0.5", "2.0", "high"])
def test_what_has_no_effect_any_more_is_accepted_with_a_warning(name, value):
    with node_with(**{name: value}) as node:
        log = Log(node)
        assert declare_parameters(node) == Settings()
        assert log.warnings == [
            f"parameter {name} has no effect any more: set localizer.max_risk instead, and remove it"
        ]
        assert not node.has_parameter(name)


@pytest.mark.parametrize("name", RETIRED)
def test_what_has_no_effect_any_more_can_be_set_later(name):
    with node_with(localizer__max_risk=0.001) as node:
        settings = declare_parameters(node)
        node.add_pre_set_parameters_callback(lambda parameters: prepare_change(node, parameters))
        log = Log(node)
        assert node.set_parameters([Parameter(name, value=0.5)])[0].successful
        assert [name in warning for warning in log.warnings] == [True]
        assert read_settings(node) == settings
        given = [Parameter("localizer.max_risk", value=0.01), Parameter(name, value=0.5)]
        assert node.set_parameters_atomically(given).successful
        assert read_settings(node).localizer.limits.max_risk == 0.01
        assert not node.has_parameter(name)


def test_without_names_that_were_retired_nothing_is_said():
    with node_with(localizer__max_risk=0.001) as node:
        log = Log(node)
        assert declare_parameters(node).localizer.limits.max_risk == 0.001
        given = [Parameter("mode", value="on_prior")]
        assert prepare_change(node, given) == given
        assert log.warnings == []


@pytest.mark.parametrize(("name", "value"), [("mode", "sometimes"), ("matcher__name", "orb")])
def test_what_is_none_of_the_choices_is_refused(name, value):
    with node_with(**{name: value}) as node, pytest.raises(ValueError, match=f"'{value}' is not one of"):
        declare_parameters(node)


@pytest.mark.parametrize(
    ("name", "value"),
    [("max_rate", "fast"), ("renderer__sh_degree", "4"), ("renderer__sh_degree", "1.0"), ("map__path", "5")],
)
def test_what_is_of_another_type_or_out_of_range_is_refused(name, value):
    with node_with(**{name: value}) as node, pytest.raises(ParameterException):
        declare_parameters(node)


@pytest.mark.parametrize("value", ["[0, 0, 1]", "[0.0, 0, 1]", "[0,0.0,1e0]"])
def test_integers_are_taken_for_doubles(value):
    (translation,) = with_lists_of_doubles([value.join(["map.translation:=", ""])])
    with node_with(max_rate="2", map__translation=translation.split(":=")[1]) as node:
        settings = declare_parameters(node)
        assert (settings.node.max_rate, settings.map.translation) == (2.0, (0.0, 0.0, 1.0))
        node.add_pre_set_parameters_callback(lambda parameters: prepare_change(node, parameters))
        assert node.set_parameters([Parameter("max_rate", value=3)])[0].successful
        assert repr(node.get_parameter("max_rate").value) == "3.0"
        assert not node.set_parameters([Parameter("max_rate", value=True)])[0].successful
        assert not node.set_parameters([Parameter("localizer.min_inliers", value=30.0)])[0].successful


def test_lists_that_are_not_of_doubles_stay_as_they_are():
    others = [
        "localizer",
        "--ros-args",
        "-p",
        "a:=[1, 2]",
        "-r",
        "image:=/a.b",
        "b:=[x.y, 1.0]",
        "__ns:=/r.2",
        "c:=2.0",
    ]
    assert with_lists_of_doubles(others) == others


def test_a_name_that_is_none_is_named_with_the_nearest():
    with node_with(map__pth="/a", localizer__max_view=3, volume=11, use_sim_time="false") as node:
        log = Log(node)
        assert declare_parameters(node) == Settings()
        assert [warning.removesuffix(" has them all").split()[1] for warning in log.warnings] == [
            "map.pth",
            "localizer.max_view",
            "volume",
        ]
        assert ["is it map.path?" in log.warnings[0], "is it localizer.max_views?" in log.warnings[1]] == [True, True]


def test_an_old_name_works_with_a_notice():
    with node_with(renderer__threads=1) as node:
        log = Log(node)
        assert declare_parameters(node).cpu.threads == 1
        assert log.warnings == ["parameter renderer.threads is called cpu.threads now: rename it"]
    with node_with(renderer__threads=1, cpu__threads=2) as node:
        assert declare_parameters(node).cpu.threads == 2


def test_paths_and_frames_are_taken_as_people_write_them(monkeypatch):
    monkeypatch.setenv("HOME", "/home/robot")
    with node_with(map__path="~/a.ply", index__path="file:///b%20c", state__path="/d", map__frame_id="/world") as node:
        settings = declare_parameters(node)
        assert (settings.map.path, settings.index.path, settings.state.path) == ("/home/robot/a.ply", "/b c", "/d")
        assert settings.map.frame_id == settings.prior_policy().map_frame == "world"
    with node_with(map__path="file://map.ply") as node, pytest.raises(ValueError, match="three slashes"):
        declare_parameters(node)
