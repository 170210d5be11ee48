"""Command-line options that tools share."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsfeatloc_ros.common.kernel_cache import can_write
from gsfeatloc_ros.common.parameter import Parameter, Value, parameters_of, values_of
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.maps import ReadOptions
from gsfeatloc_ros.render import Renderer
from gsfeatloc_ros.ros_io.parameter_file import parse_parameter

# Have options of the commands of their own.
_OWN_OPTIONS = ("max_image_width", "seed")
# Larger pictures are a slip of the finger.
_MAX_SIDE = 16384
# Localizer options that are gone, and what to use instead.
_RETIRED = dict.fromkeys(
    ("min_inlier_ratio", "min_correlation", "min_agreement"),
    "max_risk, the largest probability that an answer is wrong",
)


class CollectSettings(argparse.Action):
    """Collect pairs of a name and a value in a dictionary."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        """Add a pair."""
        assert isinstance(values, tuple)
        setattr(namespace, self.dest, getattr(namespace, self.dest) | dict([values]))


def _node_parameter(text: str) -> tuple[str, Any]:
    """Parse NAME:=VALUE of a parameter of the node."""
    try:
        return parse_parameter(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def add_node_parameters(parser: argparse.ArgumentParser, about: str) -> None:
    """Add -p, which may be given several times, for parameters of the node; `about` is its help."""
    parser.add_argument(
        "-p", dest="parameter", type=_node_parameter, action="append", default=[], metavar="NAME:=VALUE", help=about
    )


def localizer_options() -> dict[str, Parameter]:
    """Return the parameters of LocalizerOptions that OPTION=VALUE changes, by name."""
    return {
        parameter.name: parameter for parameter in parameters_of(LocalizerOptions) if parameter.name not in _OWN_OPTIONS
    }


def setting(parse: Callable[[Callable[[str], float]], Callable[[str], Any]]) -> Callable[[str], tuple[str, Any]]:
    """Make the parser of OPTION=VALUE, for a name of localizer_options.

    Args:
        parse: makes the parser of VALUE from that of a number of the option's type.
    """
    options = localizer_options()

    def parse_setting(text: str) -> tuple[str, Any]:
        name, equals, value = text.partition("=")
        if name in _RETIRED:
            raise argparse.ArgumentTypeError(f"{name} is no option any more: use {_RETIRED[name]}")
        if not equals or name not in options:
            raise argparse.ArgumentTypeError(f"{text} is not OPTION=VALUE with an option out of {', '.join(options)}")
        return name, parse(value_of(options[name]))(value)

    return parse_setting


def value_of(parameter: Parameter) -> Callable[[str], float]:
    """Make the parser of a number that a parameter takes."""

    def parse(text: str) -> float:
        value = number(int if isinstance(parameter.default, int) else float, -math.inf)(text)
        try:
            parameter.converted(value)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error
        return value

    return parse


def number(kind: Callable[[str], float], minimum: float, maximum: float = math.inf) -> Callable[[str], float]:
    """Make the parser of a finite number, a whole one where `kind` is int, of at least and at most so much."""
    bounds = [f"at {side} {bound:g}" for side, bound in (("least", minimum), ("most", maximum)) if math.isfinite(bound)]
    wanted = ("a whole number" if kind is int else "a number") + (" of " + " and ".join(bounds) if bounds else "")

    def parse(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and minimum <= value <= maximum):
            raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}")
        return value

    return parse


def picture_size(text: str) -> tuple[int, int]:
    """Parse width and height of a picture, as 640x480."""
    width, _, height = text.partition("x")
    if not all(side.isdecimal() and 0 < int(side) <= _MAX_SIDE for side in (width, height)):
        raise argparse.ArgumentTypeError(f"{text} is not a size like 640x480, of at most {_MAX_SIDE}")
    return int(width), int(height)


def check_outputs(*paths: Path | None) -> None:
    """Raise ValueError where a file that is to be written cannot be: now, not after the work. None is no file."""
    for path in filter(None, paths):
        folder = path.absolute().parent
        if path.is_dir():
            raise ValueError(f"{path}: cannot be written, it is a folder: name another file")
        if not folder.is_dir():
            raise ValueError(f"{path}: cannot be written, there is no folder {folder}: name another file")
        # /dev/stdout, say, is there, where no other can be made.
        if not can_write(folder) and not os.access(path, os.W_OK):
            raise ValueError(f"{path}: cannot be written: name another file")


def add_map_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of where the map lies, for `map_settings`; the parser has `map`, its path."""
    default, finite = MapSettings(), number(float, -math.inf)
    frame = parser.add_argument_group("the map's frame", "as the node's parameters map.*")
    frame.add_argument("--map-frame", default=default.frame_id, metavar="NAME", help="default: %(default)s")
    frame.add_argument("--map-scale", type=finite, default=default.scale, metavar="S", help="default: %(default)s")
    frame.add_argument("--map-translation", type=finite, nargs=3, default=default.translation, metavar=("X", "Y", "Z"))
    frame.add_argument("--map-rotation", type=finite, nargs=4, default=default.rotation, metavar=("X", "Y", "Z", "W"))
    frame.add_argument("--dataparser-transforms", default="", metavar="FILE", help="nerfstudio's")
    file = parser.add_argument_group("the map's file", "what it may leave open, as the node's parameters map.*")
    for option in parameters_of(ReadOptions):
        file.add_argument(
            f"--map-{option.name.replace('_', '-')}",
            type=type(option.default),
            choices=option.choices or None,
            default=option.default,
            help="default: %(default)s",
        )


def print_reading(tool: str, renderer: Renderer) -> None:
    """Print to the terminal what there is to say of how a map's file was read."""
    for note in renderer.reading.notes:
        print(f"{tool}: map: {note}", file=sys.stderr)


def map_settings(options: argparse.Namespace) -> MapSettings:
    """Return the map that options name, and where it lies."""
    return MapSettings(
        path=str(options.map),
        frame_id=options.map_frame,
        scale=options.map_scale,
        translation=tuple(options.map_translation),
        rotation=tuple(options.map_rotation),
        dataparser_transforms=options.dataparser_transforms,
        reading=ReadOptions(options.map_antialiased, options.map_spz_axes, options.map_level),
    )


def given_map(options: argparse.Namespace) -> dict[str, Value]:
    """Return the node's parameters map.* that options name: those that are not the default."""
    default = values_of(MapSettings(), "map.")
    named = replace(map_settings(options), path=str(options.map or ""))
    return {name: value for name, value in values_of(named, "map.").items() if value != default[name]}


def add_old_name(parser: argparse.ArgumentParser, option: argparse.Action, old: str) -> None:
    """Let an option that takes one value have its old name as well, with a notice; --help does not show it.

    Args:
        parser: that has the option.
        option: what parser.add_argument returned.
        old: the old name, e.g. "--most".
    """

    class OldName(argparse.Action):
        def __call__(
            self,
            parser: argparse.ArgumentParser,
            namespace: argparse.Namespace,
            values: str | Sequence[Any] | None,
            option_string: str | None = None,
        ) -> None:
            new = option.option_strings[0]
            print(f"{old} is now {new}; the old name works until the next release", file=sys.stderr)
            setattr(namespace, self.dest, values)

    parser.add_argument(
        old,
        action=OldName,
        dest=option.dest,
        type=option.type or str,
        default=argparse.SUPPRESS,
        help=argparse.SUPPRESS,
    )
