"""The node's settings as ROS parameters: declare them, read them, check changes."""

from __future__ import annotations

from collections.abc import Sequence

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from gsfeatloc_ros.common.parameter import Parameter
from gsfeatloc_ros.node.settings import PARAMETERS, Settings

# New names by old ones, which still work for one release.
_RENAMED = {"localizer.min_agreement": "localizer.min_correlation"}

_BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return what `ros2 param describe` shows and rclpy enforces."""
    made = ParameterDescriptor(description=parameter.description, read_only=not parameter.live)
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
    """Declare all parameters on a node and return their values.

    Raises:
        ValueError: a value that is not one of the choices.
        rclpy.exceptions.ParameterException: a value of another type (a double needs a point: 5.0) or out of range.
    """
    for parameter in PARAMETERS:
        # Lists are tuples in settings, of which rclpy knows nothing.
        default = list(parameter.default) if isinstance(parameter.default, tuple) else parameter.default
        node.declare_parameter(parameter.name, default, descriptor(parameter))
    for old, new in _RENAMED.items():
        _take_old_name(node, old, new)
    check_choices([node.get_parameter(name) for name in _BY_NAME])
    return read_settings(node)


def read_settings(node: Node) -> Settings:
    """Return the values of all parameters, which are declared."""
    values = {name: node.get_parameter(name).value for name in _BY_NAME}
    lists = {name: tuple(values[name]) for name, item in _BY_NAME.items() if isinstance(item.default, tuple)}
    return Settings.of(values | lists)


def check_choices(parameters: Sequence[RosParameter]) -> None:
    """Raise ValueError where a value is not one of its parameter's choices; parameters of other names are let pass."""
    for parameter in parameters:
        if parameter.name in _BY_NAME:
            _BY_NAME[parameter.name].check(parameter.value)


def with_new_names(node: Node, parameters: Sequence[RosParameter]) -> list[RosParameter]:
    """Return parameters that are about to be set, with new names in place of old ones, of which the node warns."""
    renamed = []
    for parameter in parameters:
        name = _RENAMED.get(parameter.name, parameter.name)
        if name != parameter.name:
            node.get_logger().warning(f"parameter {parameter.name} is now {name}: set that")
        renamed.append(RosParameter(name, parameter.type_, parameter.value))
    return renamed


def _take_old_name(node: Node, old: str, new: str) -> None:
    """Use a value that was given under an old name, unless one was given under the new name.

    What is the default counts as not given: the file of parameters that the launch file passes has it.
    """
    value = node.declare_parameter(old, descriptor=ParameterDescriptor(dynamic_typing=True)).value
    node.undeclare_parameter(old)
    if value is None:
        return
    given = node.get_parameter(new).value
    if given != _BY_NAME[new].default:
        node.get_logger().warning(f"parameter {old} is now {new}, which is {given}: {old} does not count, remove it")
        return
    node.get_logger().warning(f"parameter {old} is now {new}: rename it; until the next release its value is used")
    result = node.set_parameters([RosParameter(new, value=value)])[0]
    if not result.successful:
        raise ValueError(f"parameter {old}: {result.reason}")
