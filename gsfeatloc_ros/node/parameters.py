"""The node's settings as ROS parameters: declare them, read them, check changes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from gsfeatloc_ros.common.parameter import Parameter
from gsfeatloc_ros.common.words import in_one_line, shortened
from gsfeatloc_ros.ros_io.old_parameters import RENAMED, RETIRED, notice
from gsfeatloc_ros.ros_io.settings import PARAMETERS, Settings, nearest_name

# Set, the map is loaded, even if it is the same.
PATH = "map.path"
# Of parameters that rclpy declares with the topics.
_QOS = "qos_overrides."

_BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return what `ros2 param describe` shows and rclpy enforces."""
    made = ParameterDescriptor(
        description=parameter.description, read_only=not parameter.live, dynamic_typing=parameter.is_switch
    )
    if parameter.choices:
        made.additional_constraints = f"One of {', '.join(parameter.choices)}."
    if parameter.bounds is not None:
        low, high = parameter.bounds
        if isinstance(parameter.default, float):
            made.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        else:
            made.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return made


def declare_parameters(node: Node) -> Settings:
    """Declare all parameters on a node, warn of those given that are none, and return their values.

    Raises:
        ValueError: a value that is not one of the choices, or a path that cannot be used.
        rclpy.exceptions.ParameterException: a value of another type or out of range.
    """
    # rclpy has no other way to see what was given.
    given = node._parameter_overrides
    for old, new in RENAMED.items():
        if old in given:
            node.get_logger().warning(notice(old))
            given.setdefault(new, RosParameter(new, value=given.pop(old).value))
    for parameter in PARAMETERS:
        if parameter.name in given:
            given[parameter.name] = _as_declared(given[parameter.name])
        # Lists are tuples in settings, of which rclpy knows nothing.
        default = list(parameter.default) if isinstance(parameter.default, tuple) else parameter.default
        node.declare_parameter(parameter.name, default, descriptor(parameter))
    for name in given:
        if name in RETIRED:
            node.get_logger().warning(notice(name))
        elif not node.has_parameter(name) and not name.startswith(_QOS):
            _warn_of_unknown(node, name)
    check_choices([node.get_parameter(name) for name in _BY_NAME])
    return read_settings(node)


def read_settings(node: Node) -> Settings:
    """Return the values of all parameters, which are declared."""
    values: dict[str, Any] = {name: item.as_set(node.get_parameter(name).value) for name, item in _BY_NAME.items()}
    lists = {name: tuple(values[name]) for name, item in _BY_NAME.items() if isinstance(item.default, tuple)}
    return Settings.of(values | lists)


def check_choices(parameters: Sequence[RosParameter]) -> None:
    """Raise ValueError where a value is not one of its parameter's choices; parameters of other names are let pass."""
    for parameter in parameters:
        if parameter.name in _BY_NAME:
            about = _BY_NAME[parameter.name]
            about.check(about.as_set(parameter.value))


def prepare_change(node: Node, parameters: Sequence[RosParameter]) -> list[RosParameter]:
    """Return parameters that are about to be set, as they are declared; those without effect are warned of instead."""
    kept = []
    for parameter in parameters:
        if parameter.name in RETIRED:
            node.get_logger().warning(notice(parameter.name))
        else:
            kept.append(_as_declared(parameter))
    # rclpy says that setting no parameter fails: what was to be set instead stays as it is.
    return kept or [node.get_parameter(RETIRED[parameter.name]) for parameter in parameters[:1]]


def refuse_unreadable(node: Node) -> None:
    """Have a node refuse values that rclpy cannot read, with the reason, where rclpy answers nothing.

    Such are values of a type that there is not, and names that no parameter can have.
    """

    def set_each(request: SetParameters.Request, response: SetParameters.Response) -> SetParameters.Response:
        response.results = [_set_atomically(node, [parameter]) for parameter in request.parameters]
        return response

    def set_all(
        request: SetParametersAtomically.Request, response: SetParametersAtomically.Response
    ) -> SetParametersAtomically.Response:
        response.result = _set_atomically(node, request.parameters)
        return response

    callbacks = {SetParameters: set_each, SetParametersAtomically: set_all}
    for service in node.services:
        service.callback = callbacks.get(service.srv_type, service.callback)


def _set_atomically(node: Node, messages: Sequence[ParameterMessage]) -> SetParametersResult:
    try:
        return node.set_parameters_atomically([RosParameter.from_parameter_msg(message) for message in messages])
    except Exception as error:
        names = ", ".join(shortened(repr(message.name), 100) for message in messages)
        return SetParametersResult(successful=False, reason=shortened(f"{names} cannot be set: {in_one_line(error)}"))


def with_lists_of_doubles(arguments: Sequence[str]) -> list[str]:
    """Return command line arguments in which a list such as [0.0, 0, 1] has doubles alone: rcl takes no other."""

    def doubles(match: re.Match[str]) -> str:
        try:
            return f"{match[1]}[{', '.join(str(float(number)) for number in match[2].split(','))}]"
        except ValueError:
            return match[0]

    return [re.sub(r"^([\w.:/~*]+:=)\[(.*[.eE].*)\]$", doubles, argument) for argument in arguments]


def _as_declared(parameter: RosParameter) -> RosParameter:
    """Return a parameter with its integers as doubles where it is declared with these."""
    declared = _BY_NAME.get(parameter.name)
    if declared is not None and parameter.type_ is RosParameter.Type.INTEGER:
        return RosParameter(parameter.name, value=declared.with_doubles(parameter.value))
    if declared is not None and parameter.type_ is RosParameter.Type.INTEGER_ARRAY:
        return RosParameter(parameter.name, value=list(declared.with_doubles(tuple(parameter.value))))
    return parameter


def _warn_of_unknown(node: Node, name: str) -> None:
    near = nearest_name(name)
    advice = f"is it {near}?" if near else "docs/parameters.md has them all"
    node.get_logger().warning(f"parameter {name} is none of this node's, and has no effect: {advice}")
