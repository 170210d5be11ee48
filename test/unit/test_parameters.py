"""The node's settings: described once, and the same in ROS, in the YAML and in the documents."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from gsfeatloc_ros.common.geometry import quaternion_from_matrix, so3_exp
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.maps import Similarity
from gsfeatloc_ros.ros_io.growth import GrowthOptions
from gsfeatloc_ros.ros_io.prior import PriorPolicy
from gsfeatloc_ros.ros_io.settings import PARAMETERS, ImageSettings, NodeSettings, RecoverySettings, Settings
from gsfeatloc_ros.tools.parameters import main, page_text, yaml_text

ROOT = Path(__file__).parents[2]
DEFAULTS = {parameter.name: parameter.default for parameter in PARAMETERS}
by_name = pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda parameter: parameter.name)


def test_files_are_as_they_are_generated():
    assert main(["--check", "--root", str(ROOT)]) == 0
    assert (ROOT / "config" / "localizer.yaml").read_text() == yaml_text()
    assert (ROOT / "docs" / "parameters.md").read_text() == page_text()


def test_what_is_out_of_date_is_named_and_written(tmp_path, capsys):
    for folder in ("config", "docs"):
        (tmp_path / folder).mkdir()
    (tmp_path / "docs" / "parameters.md").write_text("old")
    assert main(["--check", "--root", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert f"{tmp_path}/config/localizer.yaml is out of date" in said
    assert f"{tmp_path}/docs/parameters.md is out of date" in said
    assert (tmp_path / "docs" / "parameters.md").read_text() == "old"
    assert main(["--root", str(tmp_path)]) == 0
    assert main(["--check", "--root", str(tmp_path)]) == 0
    assert (tmp_path / "docs" / "parameters.md").read_text() == page_text()


def test_the_command_needs_no_ros():
    hide = "import sys; sys.modules.update(dict.fromkeys(['rclpy', 'rcl_interfaces', 'sensor_msgs']));"
    code = f"{hide} from gsfeatloc_ros.tools.parameters import main; sys.exit(main(['--check']))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_yaml_has_every_parameter_with_its_default_and_type():
    tree = yaml.safe_load(yaml_text())["/**"]["ros__parameters"]
    values = {name: value for name, value in tree.items() if not isinstance(value, dict)}
    groups = {name: value for name, value in tree.items() if isinstance(value, dict)}
    values |= {f"{group}.{name}": value for group, names in groups.items() for name, value in names.items()}
    defaults = {name: list(value) if isinstance(value, tuple) else value for name, value in DEFAULTS.items()}
    assert values == defaults
    assert {name: type(value) for name, value in values.items()} == {n: type(v) for n, v in defaults.items()}


@by_name
def test_page_has_a_row_for_the_parameter(parameter):
    rows = [line for line in page_text().splitlines() if line.startswith(f"| `{parameter.name}` |")]
    assert len(rows) == 1
    assert rows[0].endswith(f" {parameter.description} |")
    assert ("| live |" in rows[0]) == parameter.live
    assert all(f"`{choice}`" in rows[0] for choice in parameter.choices)


@by_name
def test_descriptor_is_what_the_parameter_is(parameter):
    node_parameters = pytest.importorskip("gsfeatloc_ros.node.parameters", reason="ROS is not installed")
    made = node_parameters.descriptor(parameter)
    assert made.description == parameter.description
    assert made.read_only != parameter.live
    ranges = [*made.integer_range, *made.floating_point_range]
    if isinstance(parameter.default, str | bool | tuple):
        assert not ranges
        assert not parameter.bounds
    else:
        assert (ranges[0].from_value, ranges[0].to_value) == parameter.bounds
        assert parameter.bounds[0] <= parameter.default <= parameter.bounds[1]
        assert bool(made.floating_point_range) == isinstance(parameter.default, float)
    assert ("One of" in made.additional_constraints) == bool(parameter.choices)
    parameter.check(parameter.default)


def test_every_name_is_of_one_parameter():
    assert len(DEFAULTS) == len(PARAMETERS)


def test_settings_of_the_defaults_are_the_defaults():
    assert Settings.of({}) == Settings.of(DEFAULTS) == Settings()


@by_name
def test_each_value_comes_to_one_setting(parameter):
    other = {bool: True, int: 5, float: 0.125, str: "other", tuple: (1.0, 2.0, 3.0)}[type(parameter.default)]
    value = (not parameter.default) if isinstance(parameter.default, bool) else other
    settings = Settings.of({parameter.name: value})
    assert settings != Settings()
    assert Settings.of(DEFAULTS | {parameter.name: value}) == settings
    assert repr(settings) != repr(Settings())
    assert repr(value) in repr(settings)


def test_what_is_no_parameter_does_not_count():
    assert Settings.of({"use_sim_time": True, "map.nothing": 1}) == Settings()


def test_options_of_the_localizer_are_parameters_but_for_those_of_experts():
    options = LocalizerOptions()
    nested = [getattr(options, name) for name in ("pose", "limits", "lift")]
    groups = {"pose", "limits", "lift", "search"}
    names = {item.name for settings in (options, *nested) for item in fields(settings)} - groups
    parameters = {name.removeprefix("localizer.") for name in DEFAULTS if name.startswith("localizer.")}
    experts = {"cauchy_scale", "shared_share", "min_alpha", "max_depth_step", "max_depth_spread", "max_scatter"}
    assert names - parameters == experts
    assert parameters <= names
    # What the node sets from image to image.
    searched = {f"search.{item.name}" for item in fields(options.search)} - {
        "search.skipped",
        "search.usual_covariance",
    }
    assert searched <= DEFAULTS.keys()


def test_the_page_names_those_that_have_no_effect_any_more():
    """They are accepted for one release: none of them is a parameter."""
    assert "renderer.threads" not in DEFAULTS
    retired = {f"localizer.{name}" for name in ("min_inlier_ratio", "min_correlation", "min_agreement")}
    assert not retired & DEFAULTS.keys()
    assert all(f"`{name}`" in page_text() and name not in yaml_text() for name in retired)


def test_policy_on_priors_follows_the_settings():
    assert Settings().prior_policy() == PriorPolicy()
    node = NodeSettings(prior_frame="base", base_frame="body", prior_max_age=2.0, odometry_max_age=3.0)
    settings = replace(Settings(), node=node, image=ImageSettings(timeout=1.0))
    assert settings.prior_policy() == PriorPolicy("map", "body", True, 2.0, 3.0)
    growth = GrowthOptions(max_speed=2.0)
    settings = replace(Settings(), recovery=RecoverySettings(planar=True, growth=growth))
    assert settings.prior_policy() == PriorPolicy(planar=True, growth=growth)


def test_a_prior_of_which_nothing_is_known_is_as_uncertain_for_the_node_as_for_the_localizer():
    options = LocalizerOptions(prior_translation=2.0, prior_rotation=40.0)
    policy = replace(Settings(), localizer=options).prior_policy()
    np.testing.assert_array_equal(policy.default_covariance(), options.prior_covariance())
    np.testing.assert_array_equal(PriorPolicy().default_covariance(), LocalizerOptions().prior_covariance())


# The map's frame.

ALIGNMENT = Similarity(2.5, so3_exp(np.array([0.4, -1.1, 2.0])), np.array([12.0, -7.0, 3.0]))


def test_alignment_without_settings_is_none():
    alignment = MapSettings().alignment()
    assert alignment.scale == 1.0
    assert (alignment.rotation == np.eye(3)).all()
    assert (alignment.translation == 0).all()


def test_quaternion_is_normalized():
    alignment = MapSettings(rotation=(0.0, 0.0, 5.0, 5.0)).alignment()
    np.testing.assert_allclose(alignment.rotation, so3_exp(np.array([0, 0, np.pi / 2])), atol=1e-12)


@pytest.mark.parametrize("transforms", [False, True])
def test_alignment_is_scale_then_rotation_then_translation_after_nerfstudio(tmp_path, transforms):
    settings = MapSettings(
        scale=ALIGNMENT.scale,
        rotation=tuple(quaternion_from_matrix(ALIGNMENT.rotation)),
        translation=tuple(ALIGNMENT.translation),
    )
    points = np.random.default_rng(0).normal(size=(20, 3))
    in_data = points
    if transforms:
        path = tmp_path / "dataparser_transforms.json"
        turn, shift = so3_exp(np.array([0.3, 0.2, -0.9])), np.array([1.0, 2.0, 3.0])
        path.write_text(json.dumps({"transform": np.column_stack([turn, shift]).tolist(), "scale": 0.25}))
        settings = replace(settings, dataparser_transforms=str(path))
        in_data = (points / 0.25 - shift) @ turn  # x_splat = scale * (turn @ x_data + shift), undone
    expected = 2.5 * in_data @ ALIGNMENT.rotation.T + ALIGNMENT.translation
    np.testing.assert_allclose(settings.alignment().transform(points), expected, atol=1e-9)
