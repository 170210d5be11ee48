"""Settings as fields of frozen dataclasses, each described once.

What a field is for, its range and its choices stand beside its default. The node's parameters, config/localizer.yaml,
docs/parameters.md and the tools' options are made from that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar, cast

T = TypeVar("T")
Settings = TypeVar("Settings")

Value = str | bool | int | float | tuple[float, ...]

_KEY, _GROUP = "parameter", "group"
# What people call the types.
_KINDS = {str: "text", bool: "truth (true, false)", int: "whole number", float: "number", tuple: "list of numbers"}


@dataclass(frozen=True)
class Parameter:
    """A setting.

    Attributes:
        name: with dots between the groups.
        default: its type is the parameter's type.
        description: what it does, with the unit.
        bounds: lowest and highest value of a single number; None for texts, booleans and lists.
        choices: the values that a text may have; empty for any.
        live: whether it can be set while the node runs; otherwise only when it starts.
    """

    name: str
    default: Value
    description: str
    bounds: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    live: bool = False

    @property
    def is_switch(self) -> bool:
        """Whether true and false are among the choices, which YAML and the command line take for booleans."""
        return "true" in self.choices

    def as_set(self, value: Value) -> Value:
        """Return a value as it is in settings: a boolean as the choice of that name."""
        return str(value).lower() if self.is_switch and isinstance(value, bool) else value

    def converted(self, value: object) -> Value:
        """Return a value as one of the parameter's type: a whole number is a number, a list a tuple of them.

        Raises:
            ValueError: it is of another type, out of range, or not one of the choices.
        """
        kind = type(self.default)
        if isinstance(value, bool):
            value = self.as_set(value)
        if isinstance(value, list | tuple) and kind is tuple and all(type(item) in (int, float) for item in value):
            return self.with_doubles(tuple(value))
        if type(value) is int:
            value = self.with_doubles(value)
        if type(value) is not kind:
            raise ValueError(f"parameter {self.name}: {value!r} is no {_KINDS[kind]}")
        if self.bounds and isinstance(value, int | float) and not self.bounds[0] <= value <= self.bounds[1]:
            raise ValueError(f"parameter {self.name}: {value} is not within {self.bounds[0]:g} and {self.bounds[1]:g}")
        self.check(value)
        return value

    def with_doubles(self, value: Any) -> Any:
        """Return a number, or a tuple of numbers, as doubles where the parameter is of these; all else as it is."""
        if isinstance(self.default, float) and type(value) is int:
            return float(value)
        if isinstance(self.default, tuple) and isinstance(value, tuple):
            return tuple(float(item) for item in value)
        return value

    def check(self, value: Value) -> None:
        """Raise ValueError where `value`, as it is in settings, is not one of the choices."""
        if self.choices and value not in self.choices:
            raise ValueError(f"parameter {self.name}: {value!r} is not one of {', '.join(self.choices)}")


def parameter(
    default: T,
    description: str,
    bounds: tuple[float, float] | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> T:
    """Make a dataclass field that is a parameter; arguments as the attributes of Parameter."""
    about = Parameter("", cast(Value, default), description, bounds, choices, live)
    return field(default=default, metadata={_KEY: about})


def group(name: str) -> Mapping[str, str]:
    """Return the metadata of a field of settings whose parameters are in a group of their own, wherever it is."""
    return {_GROUP: f"{name}."}


def parameters_of(settings: type, prefix: str = "") -> Iterator[Parameter]:
    """Yield the parameters of a dataclass, and of its fields that are dataclasses, under `prefix` or in their group."""
    for item in fields(settings):
        if _KEY in item.metadata:
            yield replace(item.metadata[_KEY], name=prefix + item.name)
        elif is_dataclass(item.default_factory):
            yield from parameters_of(cast(type, item.default_factory), item.metadata.get(_GROUP, prefix))


def values_of(settings: object, prefix: str = "") -> dict[str, Value]:
    """Return the parameter values of a settings dataclass by name, as `settings_from` takes them."""
    values: dict[str, Value] = {}
    for item in fields(cast(Any, settings)):
        value = getattr(settings, item.name)
        if _KEY in item.metadata:
            values[prefix + item.name] = value
        elif is_dataclass(item.default_factory):
            values |= values_of(value, item.metadata.get(_GROUP, prefix))
    return values


def settings_from(settings: type[Settings], values: Mapping[str, Value], prefix: str = "") -> Settings:
    """Make a settings dataclass of parameter values by name; those that are not there have their defaults."""
    arguments: dict[str, Any] = {}
    for item in fields(cast(Any, settings)):
        if _KEY in item.metadata:
            if prefix + item.name in values:
                arguments[item.name] = values[prefix + item.name]
        elif is_dataclass(item.default_factory):
            nested = item.metadata.get(_GROUP, prefix)
            arguments[item.name] = settings_from(cast(type, item.default_factory), values, nested)
    return settings(**arguments)
