"""The settings of the node, and of replay: the ROS parameters. This imports nothing of ROS."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from gsfeatloc_ros.common.parameter import Parameter, Value, parameter, parameters_of, settings_from
from gsfeatloc_ros.common.paths import local_path
from gsfeatloc_ros.index import IndexOptions
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import CpuSettings, MapSettings, MatcherSettings, RendererSettings
from gsfeatloc_ros.ros_io.cross_check import CrossCheckOptions
from gsfeatloc_ros.ros_io.decode import frame_name
from gsfeatloc_ros.ros_io.extrinsics import AnswerFrames
from gsfeatloc_ros.ros_io.growth import GrowthOptions
from gsfeatloc_ros.ros_io.old_parameters import RENAMED, notice
from gsfeatloc_ros.ros_io.prior import PriorPolicy
from gsfeatloc_ros.ros_io.state import StateOptions

CONTINUOUS, ON_PRIOR, ON_REQUEST = "continuous", "on_prior", "on_request"
CAMERA, BASE = "camera", "base"
RAW, COMPRESSED = "raw", "compressed"

_log = logging.getLogger(__name__)

_POLICY = PriorPolicy()
_PLACED = "map.scale, map.translation and map.rotation put the map where"


@dataclass(frozen=True)
class NodeSettings:
    """When the node works, and of what its poses are."""

    mode: str = parameter(
        CONTINUOUS,
        "When to localize: continuous (the newest image), on_prior (one image for each prior), on_request (services).",
        choices=(CONTINUOUS, ON_PRIOR, ON_REQUEST),
        live=True,
    )
    max_rate: float = parameter(
        0.0,
        "Most images localized a second, by their stamps, as evenly as they come, to within 2 %; 0 for no limit.",
        (0.0, 1000.0),
        live=True,
    )
    autostart: bool = parameter(True, "Load the map and start at once; false waits for a lifecycle manager.")
    track: bool = parameter(
        False, "Go on from the last answer until a prior comes, carried by odometry (on odom) where there is some."
    )
    prior_frame: str = parameter(
        CAMERA, "What priors are poses of: camera (its optical frame) or base.", choices=(CAMERA, BASE)
    )
    pose_frame: str = parameter(
        CAMERA, "What answers are poses of: camera (its optical frame) or base.", choices=(CAMERA, BASE)
    )
    base_frame: str = parameter(
        _POLICY.base_frame, "Name of the robot base's frame; tf must know the way from it to the camera."
    )
    odom_frame: str = parameter("odom", "Name of the odometry's frame, for publish_tf.")
    publish_tf: bool = parameter(
        False, "Broadcast the transform from the map's frame to odom_frame; needs map.aligned."
    )
    planar_tf: bool = parameter(
        False, "Keep that transform flat, x, y and yaw alone: for a robot whose base stays on the map's plane z = 0."
    )
    transform_tolerance: float = parameter(
        0.1, "Seconds by which the stamp of that transform is ahead of the clock.", (0.0, 10.0)
    )
    prior_max_age: float = parameter(
        _POLICY.max_age,
        "Seconds for which a prior holds as it is; round an older one a wider space is searched. It may be newer than "
        "the image by no more. 0 for no limit.",
        (0.0, 1e6),
        live=True,
    )
    odometry_max_age: float = parameter(
        _POLICY.odometry_max_age,
        "Seconds over which odometry carries a prior, or the last answer, to the image's time.",
        (0.0, 3600.0),
    )

    def answer_frames(self) -> AnswerFrames:
        """Return which frames answers need."""
        return AnswerFrames(
            body=self.base_frame if self.pose_frame == BASE else "",
            odom=self.odom_frame if self.publish_tf else "",
            flat_base=self.base_frame if self.planar_tf else "",
        )


@dataclass(frozen=True)
class ImageSettings:
    """How images come."""

    transport: str = parameter(
        RAW,
        "How images come: raw (on the topic image), or compressed (JPEG or PNG, on image/compressed).",
        choices=(RAW, COMPRESSED),
    )
    rectified: bool = parameter(
        False, "Whether images are rectified: then the camera is that of camera_info's P, without distortion."
    )
    line_delay: float = parameter(
        0.0,
        "Seconds from a row to the next of a rolling shutter, whose effect is taken out by odometry; stamps are of the "
        "middle row. 0 for a global shutter.",
        (0.0, 0.001),
        live=True,
    )
    bits: int = parameter(
        0,
        "Bits that the values of 16-bit images have; 0 for what the largest needs. 16UC1 (depth, or infrared) is taken "
        "as a picture only where this is set.",
        (0, 16),
    )
    timeout: float = parameter(
        5.0, "Seconds without an image after which there is none for requests.", (0.1, 3600.0), live=True
    )


@dataclass(frozen=True)
class RequestSettings:
    """How many requests are taken, and for how long each may wait."""

    max_waiting: int = parameter(
        8,
        "Most requests that wait, for their turn or for an answer that they share; one more is told `busy` at once.",
        (1, 10_000),
        live=True,
    )
    max_megabytes: float = parameter(
        32.0, "Most megabytes of images in the requests that wait, if more than one does.", (1.0, 100_000.0), live=True
    )
    timeout: float = parameter(
        10.0,
        "Seconds, beside those of the search, in which a request is answered; it is told `busy` where it cannot be.",
        (0.1, 3600.0),
        live=True,
    )


@dataclass(frozen=True)
class RecoverySettings:
    """How a robot is followed between answers, and found again."""

    planar: bool = parameter(
        False,
        "Whether the base stays upright on the map's plane z = 0: without a prior, only x, y and yaw are unknown. "
        "Needs map.aligned, and tf from the base to the camera.",
    )
    growth: GrowthOptions = field(default_factory=GrowthOptions)
    state: StateOptions = field(default_factory=StateOptions)


@dataclass(frozen=True)
class StateSettings:
    """What is kept for the next start."""

    path: str = parameter(
        "", "Path of a file in which the last good pose is saved; the next start, with track, looks there first."
    )


@dataclass(frozen=True)
class Settings:
    """All settings of the node, by the groups of its parameters; those of `node` are in no group."""

    node: NodeSettings = field(default_factory=NodeSettings)
    map: MapSettings = field(default_factory=MapSettings)
    image: ImageSettings = field(default_factory=ImageSettings)
    matcher: MatcherSettings = field(default_factory=MatcherSettings)
    renderer: RendererSettings = field(default_factory=RendererSettings)
    cpu: CpuSettings = field(default_factory=CpuSettings)
    localizer: LocalizerOptions = field(default_factory=LocalizerOptions)
    requests: RequestSettings = field(default_factory=RequestSettings)
    recovery: RecoverySettings = field(default_factory=RecoverySettings)
    state: StateSettings = field(default_factory=StateSettings)
    crosscheck: CrossCheckOptions = field(default_factory=CrossCheckOptions)
    index: IndexOptions = field(default_factory=IndexOptions)

    @staticmethod
    def of(values: Mapping[str, Value]) -> Settings:
        """Return the settings of parameter values by name; those that are not there have their defaults.

        Raises:
            ValueError: a path that is none of this machine.
        """
        values = {name: _cleaned(name, value) for name, value in values.items()}
        return Settings(
            node=settings_from(NodeSettings, values),
            map=settings_from(MapSettings, values, "map."),
            image=settings_from(ImageSettings, values, "image."),
            matcher=settings_from(MatcherSettings, values, "matcher."),
            renderer=settings_from(RendererSettings, values, "renderer."),
            cpu=settings_from(CpuSettings, values, "cpu."),
            localizer=settings_from(LocalizerOptions, values, "localizer."),
            requests=settings_from(RequestSettings, values, "requests."),
            recovery=settings_from(RecoverySettings, values, "search."),
            state=settings_from(StateSettings, values, "state."),
            crosscheck=settings_from(CrossCheckOptions, values, "crosscheck."),
            index=settings_from(IndexOptions, values, "index."),
        )

    def resolved(self) -> Settings:
        """Return the same with what a map bundle says of its map; raise ValueError where that cannot be used."""
        return replace(self, map=self.map.resolved())

    def check_alignment(self) -> None:
        """Raise ValueError where something is asked for that needs a map which lies where the robot's map frame is."""
        if self.node.answer_frames().odom and not self.map.aligned:
            raise ValueError(
                f"publish_tf needs map.aligned: set it to true once {_PLACED} the robot's map frame is; other nodes "
                "would believe a pose that is off"
            )
        self.check_plane()

    def check_plane(self) -> None:
        """Raise ValueError where something is asked for that needs a map whose floor is known to be z = 0."""
        if self.map.aligned:
            return
        if self.recovery.planar:
            raise ValueError(f"search.planar needs map.aligned: set it to true once {_PLACED} the floor is z = 0")
        if self.index.on_plane:
            raise ValueError(f"index.camera_height needs map.aligned: set it to true once {_PLACED} the floor is z = 0")

    def prior_policy(self) -> PriorPolicy:
        """Return what priors are worth."""
        return PriorPolicy(
            map_frame=self.map.frame_id,
            base_frame=self.node.base_frame,
            of_base=self.node.prior_frame == BASE,
            max_age=self.node.prior_max_age,
            odometry_max_age=self.node.odometry_max_age,
            translation_sigma=self.localizer.prior_translation,
            rotation_sigma=self.localizer.prior_rotation,
            growth=self.recovery.growth,
            planar=self.recovery.planar,
        )

    @staticmethod
    def checked(values: Mapping[str, Any], say: Callable[[str], None] = _log.warning) -> Settings:
        """Return the settings of values that people wrote; of parameters that are ROS's own there is no notice.

        Args:
            values: by name; those of the last release are accepted, as by the node.
            say: is told of these.

        Raises:
            ValueError: there is no such parameter, or it does not take such a value; the message says which.
        """
        known = {item.name: item for item in PARAMETERS}
        converted = {}
        # Old names first: a new one counts more.
        for given in sorted(values, key=lambda name: name not in RENAMED):
            name = RENAMED.get(given, given)
            if old := notice(given):
                say(old)
            if name in known:
                converted[name] = known[name].converted(values[given])
            elif not old and not name.startswith(_OF_ROS):
                near = nearest_name(name)
                raise ValueError(f"there is no parameter {name}{f': is {near} meant?' if near else ''}")
        return Settings.of(converted)


_OF_ROS = ("use_sim_time", "qos_overrides.", "start_type_description_service")
_PATHS = ("map.path", "map.dataparser_transforms", "matcher.weights", "state.path", "index.path")
_FRAMES = ("map.frame_id", "base_frame", "odom_frame")


def _cleaned(name: str, value: Value) -> Value:
    """Return the value of a parameter as it is used: paths without `~` and file://, frames without a leading slash."""
    if name in _PATHS:
        return local_path(str(value))
    return frame_name(str(value)) if name in _FRAMES else value


_GROUPS = {
    "": NodeSettings,
    "map.": MapSettings,
    "image.": ImageSettings,
    "matcher.": MatcherSettings,
    "renderer.": RendererSettings,
    "cpu.": CpuSettings,
    "localizer.": LocalizerOptions,
    "requests.": RequestSettings,
    "search.": RecoverySettings,
    "state.": StateSettings,
    "crosscheck.": CrossCheckOptions,
    "index.": IndexOptions,
}
_PREFIXES = list(_GROUPS)


def _place(parameter: Parameter) -> int:
    """Return the place of a parameter's group among the others."""
    return _PREFIXES.index(parameter.name[: parameter.name.rfind(".") + 1])


PARAMETERS = tuple(
    sorted((item for prefix, group in _GROUPS.items() for item in parameters_of(group, prefix)), key=_place)
)


def nearest_name(name: str) -> str:
    """Return the parameter whose name is most like another name; empty where none is like it."""
    return next(iter(difflib.get_close_matches(name, [item.name for item in PARAMETERS], n=1)), "")
