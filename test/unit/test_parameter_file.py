"""The node's parameters without ROS: files and assignments as ROS takes them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from gsfeatloc_ros.common.parameter import values_of
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.maps import ReadOptions
from gsfeatloc_ros.ros_io.old_parameters import RETIRED
from gsfeatloc_ros.ros_io.parameter_file import parse_parameter, read_parameter_file
from gsfeatloc_ros.ros_io.settings import Settings

ROOT = Path(__file__).parents[2]


def test_the_file_of_the_package_has_the_defaults():
    assert Settings.checked(read_parameter_file(ROOT / "config" / "localizer.yaml")) == Settings()


def test_groups_dots_and_nodes(tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text("""
/**: {ros__parameters: {track: true, use_sim_time: true, max_rate: 3}}
/robot/localizer: {ros__parameters: {max_rate: 2, map: {scale: 2, translation: [0, 1.5, 0]}, image.rectified: true}}
/robot/amcl: {ros__parameters: {no_such: 1}}
""")
    settings = Settings.checked(read_parameter_file(path))
    assert (settings.node.track, settings.node.max_rate) == (True, 2.0)
    assert (settings.map.scale, settings.map.translation, settings.image.rectified) == (2.0, (0.0, 1.5, 0.0), True)


def test_values_make_the_settings_again():
    settings = replace(Settings(), map=replace(MapSettings(), scale=2.0, reading=ReadOptions(antialiased="true")))
    values = values_of(settings.map, "map.")
    assert values["map.antialiased"] == "true"
    assert Settings.of(values) == settings
    # YAML takes the word for a truth.
    assert Settings.checked({"map.antialiased": True}).map.reading.antialiased == "true"


@pytest.mark.parametrize(
    ("text", "value"), [("2", 2), ("0.5", 0.5), ("true", True), ("[1, 0.0]", [1, 0.0]), ("base", "base"), ("", None)]
)
def test_assignments(text, value):
    assert parse_parameter(f"a.b:={text}") == ("a.b", value)


@pytest.mark.parametrize("text", ["a", "a=1", ":=1"])
def test_what_is_no_assignment(text):
    with pytest.raises(ValueError, match="is not NAME:=VALUE"):
        parse_parameter(text)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"max_rte": 1}, "there is no parameter max_rte: is max_rate meant"),
        ({"max_rate": "fast"}, "max_rate: 'fast' is no number"),
        ({"max_rate": -1}, "max_rate: -1.0 is not within 0 and 1000"),
        ({"track": 1}, "track: 1 is no truth"),
        ({"mode": "always"}, "mode: 'always' is not one of continuous"),
        ({"localizer.seed": 1.5}, "localizer.seed: 1.5 is no whole number"),
        ({"map.translation": [1, "2", 3]}, "map.translation: .* is no list of numbers"),
        ({"map.path": None}, "map.path: None is no text"),
    ],
)
def test_values_that_cannot_be_used(values, says):
    with pytest.raises(ValueError, match=says):
        Settings.checked(values)


@pytest.mark.parametrize("values", [{"renderer.threads": 1}, {"cpu.threads": 1, "renderer.threads": 2}])
def test_an_old_name_works_as_for_the_node(values):
    said: list[str] = []
    assert Settings.checked(values, said.append).cpu.threads == 1
    assert said == ["parameter renderer.threads is called cpu.threads now: rename it"]


@pytest.mark.parametrize("name", RETIRED)
def test_what_has_no_effect_any_more_is_accepted_as_by_the_node(name):
    said: list[str] = []
    assert Settings.checked({name: "high"}, said.append) == Settings()
    assert said == [f"parameter {name} has no effect any more: set localizer.max_risk instead, and remove it"]


@pytest.mark.parametrize(("text", "says"), [("[", "is no YAML"), ("", "has no parameters of the node localizer")])
def test_files_that_cannot_be_used(tmp_path, text, says):
    (tmp_path / "params.yaml").write_text(text)
    with pytest.raises(ValueError, match=f"params.yaml: {says}"):
        read_parameter_file(tmp_path / "params.yaml")


def test_a_pipe_in_place_of_a_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "params.yaml")
    with pytest.raises(ValueError, match=r"params\.yaml: cannot be read: is not a regular file"):
        read_parameter_file(tmp_path / "params.yaml")
