"""Settings that are described once, in the dataclasses that hold them."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from gsfeatloc_ros.common.parameter import Parameter, parameter, parameters_of, settings_from


@dataclass(frozen=True)
class Inner:
    depth: float = parameter(2.0, "Metres.", (0.0, 9.0), live=True)
    hidden: float = 7.0


@dataclass(frozen=True)
class Outer:
    kind: str = parameter("a", "Which.", choices=("a", "b"))
    inner: Inner = field(default_factory=Inner)


@dataclass(frozen=True)
class Nothing:
    hidden: int = 1


def test_no_parameters() -> None:
    assert list(parameters_of(Nothing)) == []
    assert settings_from(Nothing, {}) == Nothing()


def test_parameters_are_those_of_nested_settings_too_under_one_prefix() -> None:
    assert list(parameters_of(Outer, "group.")) == [
        Parameter("group.kind", "a", "Which.", choices=("a", "b")),
        Parameter("group.depth", 2.0, "Metres.", (0.0, 9.0), live=True),
    ]


def test_settings_are_made_of_values_by_name() -> None:
    assert settings_from(Outer, {"group.kind": "b", "group.depth": 3.0, "other.depth": 4.0}, "group.") == Outer(
        "b", Inner(3.0)
    )
    assert settings_from(Outer, {}) == Outer()


def test_choices_are_checked_by_name() -> None:
    kind, depth = parameters_of(Outer, "group.")
    kind.check("b")
    depth.check(100.0)
    with pytest.raises(ValueError, match=r"parameter group\.kind: 'c' is not one of a, b"):
        kind.check("c")
