"""The node's parameters, declared from one table. config/localizer.yaml and README.md describe the same (tested)."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from gsfeatloc_ros.common.geometry import matrix_from_quaternion
from gsfeatloc_ros.localize.localizer import LocalizerOptions
from gsfeatloc_ros.maps import Similarity, read_dataparser_transforms
from gsfeatloc_ros.match import DEFAULT_MATCHER, DEFAULT_MAX_FEATURES, MATCHERS
from gsfeatloc_ros.render import DEVICES
from gsfeatloc_ros.ros_io.inputs import PriorPolicy

BODIES = ("camera", "base")

Value = str | bool | int | float | list[float]

_POLICY = PriorPolicy()


@dataclass(frozen=True)
class Parameter:
    """A parameter of the node.

    Attributes:
        name: with dots between the groups.
        default: its type is the parameter's type.
        description: what it does, with the unit.
        bounds: lowest and highest value of a single number.
        choices: the values that a text may have; empty for any.
        live: whether it can be set while the node runs; otherwise only when it starts.
    """

    name: str
    default: Value
    description: str
    bounds: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    live: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """What `ros2 param describe` shows and rclpy enforces."""
        descriptor = ParameterDescriptor(description=self.description, read_only=not self.live)
        if self.choices:
            descriptor.additional_constraints = f"One of {', '.join(self.choices)}."
        if isinstance(self.default, float):
            descriptor.floating_point_range = [FloatingPointRange(from_value=self.bounds[0], to_value=self.bounds[1])]
        elif isinstance(self.default, int) and not isinstance(self.default, bool):
            descriptor.integer_range = [IntegerRange(from_value=self.bounds[0], to_value=self.bounds[1], step=1)]
        return descriptor


_OPTIONS = asdict(LocalizerOptions())


def _option(name: str, description: str, bounds: tuple[float, float]) -> Parameter:
    return Parameter(f"localizer.{name}", _OPTIONS[name], description, bounds, live=True)


PARAMETERS = (
    Parameter(
        "mode",
        "continuous",
        "When to localize: continuous (the newest image), on_prior (one image for each prior), on_request (services).",
        choices=("continuous", "on_prior", "on_request"),
        live=True,
    ),
    Parameter(
        "max_rate", 0.0, "Most images localized a second, by their stamps; 0 for no limit.", (0.0, 1000.0), live=True
    ),
    Parameter("autostart", True, "Load the map and start at once; false waits for a lifecycle manager."),
    Parameter(
        "track",
        False,
        "Go on from the last answer until a prior comes, carried by odometry (on odom) where there is some.",
    ),
    Parameter("prior_frame", "camera", "What priors are poses of: camera (its optical frame) or base.", choices=BODIES),
    Parameter("pose_frame", "camera", "What answers are poses of: camera (its optical frame) or base.", choices=BODIES),
    Parameter("base_frame", "base_link", "Name of the robot base's frame; tf must know the way from it to the camera."),
    Parameter("odom_frame", "odom", "Name of the odometry's frame, for publish_tf."),
    Parameter("publish_tf", False, "Broadcast the transform from the map's frame to odom_frame; needs map.aligned."),
    Parameter(
        "transform_tolerance", 0.1, "Seconds by which the stamp of that transform is ahead of the clock.", (0.0, 10.0)
    ),
    Parameter(
        "prior_max_age",
        _POLICY.max_age,
        "Seconds by which a prior, or the last answer, may be older or newer than the image; 0 for no limit.",
        (0.0, 1e6),
        live=True,
    ),
    Parameter(
        "odometry_max_age",
        _POLICY.odometry_max_age,
        "The same where odometry carries it to the image's time.",
        (0.0, 3600.0),
    ),
    Parameter(
        "map.path",
        "",
        "Path of the map (required): "
        "a .ply, compressed .ply, .splat, .spz or .sog, or the folder of an unbundled .sog.",
        live=True,
    ),
    Parameter("map.frame_id", _POLICY.map_frame, "Name of the map's frame, in which answers are given."),
    Parameter("map.aligned", False, "Whether that is the robot's map frame (metres, z up): publish_tf needs it."),
    Parameter("map.scale", 1.0, "Units of the map frame in one unit of the file.", (1e-6, 1e6)),
    Parameter("map.translation", [0.0, 0.0, 0.0], "Where the file's origin lies in the map frame: x, y, z."),
    Parameter(
        "map.rotation", [0.0, 0.0, 0.0, 1.0], "Quaternion x, y, z, w that turns the file's axes into the map frame's."
    ),
    Parameter(
        "map.dataparser_transforms",
        "",
        "Path of nerfstudio's dataparser_transforms.json, undone before the three above; empty for none.",
    ),
    Parameter(
        "map.cache",
        True,
        "Keep the map, prepared for rendering, in a file beside it (*.gsfeatloc-cache): later starts are faster.",
    ),
    Parameter(
        "image.transport",
        "raw",
        "How images come: raw (on the topic image), or compressed (JPEG or PNG, on image/compressed).",
        choices=("raw", "compressed"),
    ),
    Parameter(
        "image.rectified",
        False,
        "Whether images are rectified: then the camera is that of camera_info's P, without distortion.",
    ),
    Parameter(
        "image.timeout",
        5.0,
        "Seconds without an image after which there is none for requests.",
        (0.1, 3600.0),
        live=True,
    ),
    Parameter("matcher.name", DEFAULT_MATCHER, f"Feature matcher: {', '.join(MATCHERS)}.", choices=tuple(MATCHERS)),
    Parameter(
        "matcher.weights",
        "",
        "Path of a learned matcher's weights (two networks: of their folder); empty looks in the usual places.",
    ),
    Parameter("matcher.max_features", DEFAULT_MAX_FEATURES, "Most features taken from an image.", (64, 32768)),
    Parameter(
        "renderer.device", "auto", "Where to render, match and track: cpu, cuda, or auto to choose.", choices=DEVICES
    ),
    Parameter("renderer.threads", 0, "Threads of the CPU renderer; 0 takes all cores.", (0, 1024)),
    Parameter("renderer.sh_degree", 3, "Highest degree of the spherical harmonics of the colours drawn.", (0, 3)),
    Parameter(
        "renderer.resolution_scale", 1.0, "Draw so many times the width and height, and enlarge that.", (0.1, 1.0)
    ),
    _option("max_image_width", "Wider images are resized to this many pixels first.", (64, 16384)),
    _option("max_passes", "Most renders at estimates to which an image is tracked.", (1, 20)),
    _option(
        "max_reprojection_error", "Pixels of the resized image within which a corner agrees with a pose.", (0.1, 50.0)
    ),
    _option("min_inliers", "With fewer tracked corners that agree on a pose there is no answer.", (4, 100000)),
    _option("min_inlier_ratio", "With a smaller share of inliers among those corners there is no answer.", (0.0, 1.0)),
    _option(
        "min_coverage", "With inliers in a smaller share of the image's 8 x 6 cells there is no answer.", (0.0, 1.0)
    ),
    _option(
        "min_agreement",
        "With a smaller correlation of image and render at the estimate there is no answer.",
        (-1.0, 1.0),
    ),
    _option(
        "max_deviation",
        "Farther than this many standard deviations from the prior there is no answer.",
        (0.1, 1e6),
    ),
    _option(
        "max_views", "Most other views searched when the prior's shows nothing of the image; 0 for none.", (0, 1000)
    ),
    _option("prior_rotation", "Standard deviation of the prior in degrees about each axis.", (0.01, 180.0)),
    _option("prior_translation", "Standard deviation of the prior in map units along each axis.", (1e-6, 1e6)),
    _option("seed", "Seed of RANSAC and of the search: the same seed gives the same answer.", (0, 2**31 - 1)),
)


def declare_parameters(node: Node) -> dict[str, Value]:
    """Declare all parameters on `node` and return their values by name.

    Raises:
        ValueError: a value that is not one of the choices.
        rclpy.exceptions.ParameterException: a value of another type (a double needs a point: 5.0) or out of range.
    """
    values = {
        parameter.name: node.declare_parameter(parameter.name, parameter.default, parameter.descriptor()).value
        for parameter in PARAMETERS
    }
    check_choices(values)
    return values


def check_choices(values: dict[str, Value]) -> None:
    """Check values by name, of any parameters; raises ValueError if one is not among the parameter's choices."""
    for parameter in PARAMETERS:
        value = values.get(parameter.name)
        if parameter.choices and value is not None and value not in parameter.choices:
            raise ValueError(f"parameter {parameter.name}: {value!r} is not one of {', '.join(parameter.choices)}")


def prior_policy(values: dict[str, Value]) -> PriorPolicy:
    """What priors are worth, from the values of all parameters."""
    return PriorPolicy(
        map_frame=values["map.frame_id"],
        base_frame=values["base_frame"],
        of_base=values["prior_frame"] == "base",
        max_age=values["prior_max_age"],
        odometry_max_age=values["odometry_max_age"],
    )


def map_alignment(values: dict[str, Value]) -> Similarity:
    """Where the frame of the map file lies in the robot's map frame (S_map_splat), from the values of all parameters.

    Raises:
        ValueError: a parameter is no translation, no quaternion or no file of nerfstudio's; the message says which.
    """
    translation = _numbers(values, "map.translation", 3)
    try:
        rotation = matrix_from_quaternion(_numbers(values, "map.rotation", 4))
    except ValueError as error:
        raise ValueError(f"parameter map.rotation: {error}") from error
    alignment = Similarity(values["map.scale"], rotation, translation)
    if not values["map.dataparser_transforms"]:
        return alignment
    return alignment @ read_dataparser_transforms(values["map.dataparser_transforms"])


def _numbers(values: dict[str, Value], name: str, count: int) -> np.ndarray:
    numbers = np.array(values[name], dtype=np.float64)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"parameter {name}: {numbers.tolist()} is not {count} finite numbers")
    return numbers


def localizer_options(values: dict[str, Value]) -> LocalizerOptions:
    """Options of the Localizer from the values of all parameters."""
    return LocalizerOptions(**{name: values[f"localizer.{name}"] for name in _OPTIONS})
