"""Command-line options that tools share."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import fields

from gsfeatloc_ros.localize.localizer import LocalizerOptions


class Settings(argparse.Action):
    """Collects pairs of a name and a value in a dictionary."""

    def __call__(self, parser: object, namespace: argparse.Namespace, values: tuple, option: object = None) -> None:
        setattr(namespace, self.dest, getattr(namespace, self.dest) | dict([values]))


def localizer_options() -> dict[str, type]:
    """Names and types of the LocalizerOptions that OPTION=VALUE changes."""
    own = ("max_image_width", "seed")  # have options of the commands of their own
    kinds = {field.name: type(field.default) for field in fields(LocalizerOptions) if field.name not in own}
    return {name: kind for name, kind in kinds.items() if kind in (int, float)}


def setting(parse: Callable[[Callable[[str], float]], Callable]) -> Callable[[str], tuple]:
    """Make the parser of OPTION=VALUE, for a name of localizer_options.

    Args:
        parse: makes the parser of VALUE from that of a number of the option's type.
    """
    kinds = localizer_options()

    def parse_setting(text: str) -> tuple:
        name, equals, value = text.partition("=")
        if not equals or name not in kinds:
            raise argparse.ArgumentTypeError(f"{text} is not OPTION=VALUE with an option out of {', '.join(kinds)}")
        return name, parse(number(kinds[name], -math.inf))(value)

    return parse_setting


def number(kind: Callable[[str], float], minimum: float) -> Callable[[str], float]:
    """Make the parser of a finite number of at least `minimum`."""

    def parse(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value >= minimum):
            raise argparse.ArgumentTypeError(f"{text!r} is not a number of at least {minimum}")
        return value

    return parse
