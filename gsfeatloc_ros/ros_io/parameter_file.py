"""The node's parameters as ROS takes them, without ROS: from a parameter file, and from NAME:=VALUE."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from gsfeatloc_ros.common.yaml_file import read_yaml

NODE = "localizer"
_KEY = "ros__parameters"


def read_parameter_file(path: Path) -> dict[str, Any]:
    """Return the values of a parameter file by name: those for any node, and those for the localizer.

    Raises:
        ValueError: the file cannot be read, or has none of these; the message says why.
    """
    try:
        content = read_yaml(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: is no YAML: {error}") from error
    values: dict[str, Any] = {}
    found = False
    for node, parameters in _sections(content):
        if node in (NODE, "*", "**"):
            found = True
            values |= dict(_flat(parameters))
    if not found:
        raise ValueError(f"{path}: has no parameters of the node {NODE}: expected {NODE}: {_KEY}: ...")
    return values


def parse_parameter(text: str) -> tuple[str, Any]:
    """Return name and value of NAME:=VALUE, the value as YAML, as ros2 run takes it; raise ValueError otherwise."""
    name, assigned, value = text.partition(":=")
    if not assigned or not name:
        raise ValueError(f"{text} is not NAME:=VALUE")
    try:
        return name, yaml.safe_load(value)
    except yaml.YAMLError:
        return name, value


def _sections(content: Any) -> Iterator[tuple[str, Any]]:
    """Yield the last part of a node's name, and its parameters."""
    if isinstance(content, dict):
        for name, inner in content.items():
            if isinstance(inner, dict) and _KEY in inner:
                yield str(name).rpartition("/")[2], inner[_KEY]
            else:
                yield from _sections(inner)


def _flat(parameters: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield names with dots between the groups, and values."""
    if isinstance(parameters, dict):
        for name, value in parameters.items():
            if isinstance(value, dict):
                yield from _flat(value, f"{prefix}{name}.")
            else:
                yield f"{prefix}{name}", value
