"""Parameters in a node: what comes of the command line, and of names that have changed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import rclpy
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from gsfeatloc_ros.node.parameters import declare_parameters, read_settings, with_new_names
from gsfeatloc_ros.node.settings import PARAMETERS, Settings

OLD, NEW = "localizer.min_agreement", "localizer.min_correlation"


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
        assert not node.has_parameter(OLD)


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


def test_the_value_of_an_old_name_is_used():
    with node_with(localizer__min_agreement=0.5) as node:
        assert declare_parameters(node).localizer.limits.min_correlation == 0.5
        assert node.get_parameter(NEW).value == 0.5
        assert not node.has_parameter(OLD)


def test_the_default_under_the_new_name_does_not_count():
    """The launch file's own file of parameters gives it."""
    with node_with(localizer__min_agreement=0.5, localizer__min_correlation=0.3) as node:
        assert declare_parameters(node).localizer.limits.min_correlation == 0.5


def test_the_new_name_goes_before_the_old_one():
    with node_with(localizer__min_agreement=0.5, localizer__min_correlation=0.4) as node:
        assert declare_parameters(node).localizer.limits.min_correlation == 0.4


@pytest.mark.parametrize(("value", "says"), [("2.0", "range"), ("high", "type"), ("1", "type")])
def test_an_old_name_takes_no_more_than_the_new_one(value, says):
    with node_with(localizer__min_agreement=value) as node, pytest.raises(ValueError, match=says) as error:
        declare_parameters(node)
    assert str(error.value).startswith(f"parameter {OLD}: ")


def test_an_old_name_that_is_set_later_is_the_new_one():
    with node_with() as node:
        given = [Parameter("mode", value="on_prior"), Parameter(OLD, value=0.5)]
        named = with_new_names(node, given)
        assert [(parameter.name, parameter.value) for parameter in named] == [("mode", "on_prior"), (NEW, 0.5)]


@pytest.mark.parametrize(("name", "value"), [("mode", "sometimes"), ("matcher__name", "orb")])
def test_what_is_none_of_the_choices_is_refused(name, value):
    with node_with(**{name: value}) as node, pytest.raises(ValueError, match=f"'{value}' is not one of"):
        declare_parameters(node)


@pytest.mark.parametrize(("name", "value"), [("max_rate", "5"), ("renderer__sh_degree", "4"), ("map__path", "5")])
def test_what_is_of_another_type_or_out_of_range_is_refused(name, value):
    with node_with(**{name: value}) as node, pytest.raises(ParameterException):
        declare_parameters(node)
