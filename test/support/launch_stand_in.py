"""Stand-ins for the modules of launch and launch_ros, which are in a ROS install only: they record what is made.

Their classes take the arguments that the real ones take, so that a wrong one fails here too.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import pytest


@dataclass
class LaunchDescription:
    entities: list[Any] = field(default_factory=list)


@dataclass
class DeclareLaunchArgument:
    name: str
    default_value: Any = field(default=None, kw_only=True)
    description: str | None = field(default=None, kw_only=True)
    choices: list[str] | None = field(default=None, kw_only=True)


@dataclass
class OpaqueFunction:
    function: Callable = field(kw_only=True)


@dataclass
class LaunchContext:
    launch_configurations: dict[str, str] = field(default_factory=dict)


@dataclass
class ExecuteProcess:
    cmd: list[Any] = field(kw_only=True)
    output: str = field(default="log", kw_only=True)
    on_exit: Any = field(default=None, kw_only=True)


@dataclass
class IncludeLaunchDescription:
    launch_description_source: Any
    launch_arguments: Iterable[tuple[Any, Any]] = field(default=(), kw_only=True)


@dataclass
class RegisterEventHandler:
    event_handler: Any


@dataclass
class Shutdown:
    reason: str = field(default="", kw_only=True)


@dataclass
class OnProcessIO:
    target_action: Any = field(default=None, kw_only=True)
    on_stdin: Callable | None = field(default=None, kw_only=True)
    on_stdout: Callable | None = field(default=None, kw_only=True)
    on_stderr: Callable | None = field(default=None, kw_only=True)


@dataclass
class ProcessIO:
    text: bytes = field(kw_only=True)


@dataclass(frozen=True)
class LaunchConfiguration:
    variable_name: str
    default: Any = field(default=None, kw_only=True)

    def perform(self, context: LaunchContext) -> str:
        return context.launch_configurations[self.variable_name]


@dataclass
class PathJoinSubstitution:
    substitutions: list[Any]


@dataclass
class Node:
    executable: str = field(kw_only=True)
    package: str | None = field(default=None, kw_only=True)
    name: str | None = field(default=None, kw_only=True)
    namespace: Any = field(default=None, kw_only=True)
    parameters: list[Any] | None = field(default=None, kw_only=True)
    remappings: list[tuple[Any, Any]] | None = field(default=None, kw_only=True)
    output: str = field(default="log", kw_only=True)


@dataclass(frozen=True)
class ParameterValue:
    value: Any
    value_type: type | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class FindPackageShare:
    package: str


_MODULES = {
    "launch": (LaunchContext, LaunchDescription),
    "launch.actions": (
        DeclareLaunchArgument,
        ExecuteProcess,
        IncludeLaunchDescription,
        OpaqueFunction,
        RegisterEventHandler,
        Shutdown,
    ),
    "launch.event_handlers": (OnProcessIO,),
    "launch.events": (),
    "launch.events.process": (ProcessIO,),
    "launch.substitutions": (LaunchConfiguration, PathJoinSubstitution),
    "launch_ros": (),
    "launch_ros.actions": (Node,),
    "launch_ros.parameter_descriptions": (ParameterValue,),
    "launch_ros.substitutions": (FindPackageShare,),
}


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let launch files import the stand-ins for the time of a test."""
    for name, classes in _MODULES.items():
        module = ModuleType(name)
        for made in classes:
            setattr(module, made.__name__, made)
        monkeypatch.setitem(sys.modules, name, module)
