"""What there is while a map is loaded: reception of messages, attempts to localize, publishers, a report on them."""

from __future__ import annotations

import time
from dataclasses import replace

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from gsfeatloc_ros.common.malloc import give_back_memory
from gsfeatloc_ros.common.threads import Cores
from gsfeatloc_ros.localize.engine import Engine
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.node.attempts import Attempts, Outputs
from gsfeatloc_ros.node.diagnostics import OK, Reporter
from gsfeatloc_ros.node.graph import GraphWatch
from gsfeatloc_ros.node.index_build import IndexBuild
from gsfeatloc_ros.node.map_view import MapView
from gsfeatloc_ros.node.parameters import PATH
from gsfeatloc_ros.node.pose_file import PoseFile
from gsfeatloc_ros.node.publishers import Publishers
from gsfeatloc_ros.node.reception import Reception
from gsfeatloc_ros.node.report import Report
from gsfeatloc_ros.node.standing import StandingPublisher
from gsfeatloc_ros.node.transforms import Transforms
from gsfeatloc_ros.ros_io.cross_check import CrossCheck
from gsfeatloc_ros.ros_io.follower import Follower
from gsfeatloc_ros.ros_io.inputs import Inputs
from gsfeatloc_ros.ros_io.pictures import PictureReader
from gsfeatloc_ros.ros_io.settings import CONTINUOUS, ON_REQUEST, Settings
from gsfeatloc_ros.ros_io.state import LocalizationState, State

# Seconds between two reports on the node's health, as of diagnostic_updater, between two looks for requests that have
# waited too long, between two saves of the last pose, and until memory that is not used any more is given back.
_HEALTH_PERIOD = 1.0
_LATE_PERIOD = 0.2
_SAVE_PERIOD = 5.0
_MEMORY_PERIOD = 20.0


class Session:
    """Localizes the newest image with the newest prior, and what services ask for before that.

    Messages are received in the executor's thread. One worker thread decodes and localizes. An image is paired with the
    camera_info and the prior that are the newest when the work on it starts, a requested one with those of its request;
    if one is missing then, the image is refused and not tried again when it comes.

    Args:
        node: whose topics they are.
        settings: of the node.
        engine: that localizes.
        transforms: what tf knows; it stays when the session ends.
        reporter: writes to the log and to /diagnostics.

    Attributes:
        reception: of the messages.
        attempts: to localize.
        inputs: what images are localized with.
        report: of how it goes.
        settings: as they are now.
        cores: on which it works in the background.
        active: whether it listens and publishes.
        closed: whether it has ended.

    Raises:
        ValueError: the settings do not go together, or tf is needed and not installed.
    """

    def __init__(
        self, node: Node, settings: Settings, engine: Engine, transforms: Transforms, reporter: Reporter
    ) -> None:
        self._node, self._transforms = node, transforms
        self.settings = settings
        self.active = self.closed = False
        self.cores = Cores(settings.cpu.threads)
        state = LocalizationState(settings.recovery.state, lambda: node.get_clock().now().nanoseconds)
        inputs = Inputs(
            settings.prior_policy(),
            transforms.lookup,
            settings.image.rectified,
            f"no camera_info yet: publish sensor_msgs/CameraInfo on {node.resolve_topic_name('camera_info')}",
            PictureReader(settings.image.bits, reporter.info),
        )
        self.inputs, self._follower = inputs, Follower(inputs, state, settings.node.track)
        cross_check = CrossCheck(inputs, settings.crosscheck, settings.map.scale)
        self.report = Report(reporter, lambda: self.attempts.dropped, self._follower.camera, cross_check)

        def withheld() -> str:
            return self.report.wrong_scale if settings.node.publish_tf else ""

        def silent() -> bool:
            return state.standing().state is State.LOST or bool(withheld())

        self._publishers = Publishers(node, settings, transforms, silent)
        self._standing = StandingPublisher(node, state, reporter, withheld)
        self._pose_file = PoseFile(settings.state.path, settings.map, reporter)
        self._use_saved_pose()
        self._map_view = MapView(node, settings.map, reporter, self.cores)
        outputs = Outputs(self._publishers, self._standing, self._pose_file, self.report)
        self.attempts = Attempts(engine, self._follower, outputs)
        self.reception = Reception(node, settings, inputs, self.report, self.attempts.offer)
        self._graph = GraphWatch(node, reporter)
        self._index_build = IndexBuild(self.attempts, reporter, self.cores)
        self._index_build.start(settings)
        # On a clock of its own: that of a simulation may stand still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timers = [
            node.create_timer(_HEALTH_PERIOD, self._report_health, clock=steady),
            node.create_timer(_LATE_PERIOD, self.attempts.drop_late, clock=steady),
            node.create_timer(_SAVE_PERIOD, self._pose_file.save, clock=steady),
            node.create_timer(_MEMORY_PERIOD, give_back_memory, clock=steady),
        ]
        self.use_settings(settings)
        self._tell_reading()

    @property
    def engine(self) -> Engine:
        """The engine that localizes."""
        return self.attempts.engine

    def activate(self) -> None:
        """Listen and publish."""
        self.reception.listen()
        self._graph.begin()
        self.active = self.attempts.publishing = True
        settings, engine = self.settings, self.engine
        self._node.get_logger().info(
            f"ready: map {engine.map_path} (frame {settings.map.frame_id}), matcher {settings.matcher.name}, on "
            f"{engine.renderer.device}, {settings.node.mode}, topics {' '.join(self.reception.topics)} -> "
            f"{self._publishers.topic}"
        )
        self.report.publish_ready(f"ready: {self.reception.no_image}")
        self._standing.publish()

    def deactivate(self) -> None:
        """Neither listen nor publish."""
        self.active = self.attempts.publishing = False
        self.reception.stop_listening()
        self._follower.lose("the node was deactivated", with_priors=False)
        self.report.cross_check.forget()
        self._publishers.forget()
        self._pose_file.save()

    def stop(self, timeout: float) -> bool:
        """Have the running localization given up; return whether it ended within `timeout` seconds.

        Requests that still wait are answered when the executor spins on.
        """
        self._pose_file.save()
        deadline = time.monotonic() + timeout
        return self.attempts.stop(timeout) & self._index_build.stop(max(0.0, deadline - time.monotonic()))

    def close(self) -> None:
        """Take back all that was made, but for the subscriptions, which `deactivate` does."""
        self.closed = True
        for timer in self._timers:
            self._node.destroy_timer(timer)
        self._standing.close()
        self._map_view.close()
        self._publishers.close()

    def lose(self, reason: str) -> None:
        """Forget where the robot is: it is anywhere in the map."""
        self._follower.lose(reason, with_priors=True)
        self.report.cross_check.forget()
        self._publishers.forget()
        self._standing.publish()

    def use_map(self, engine: Engine, map_: MapSettings) -> None:
        """Go on with the map of another engine, and where it lies; the last answer was in the old one's."""
        self.settings = replace(self.settings, map=map_)
        self.attempts.use_map(engine)
        self._follower.lose("the map was changed", with_priors=False)
        self.report.cross_check.reset()
        self._publishers.forget()
        self._standing.publish()
        self._pose_file.use_map(self.settings.map)
        self._map_view.use_map(self.settings.map)
        self._tell_reading()
        self._index_build.start(self.settings)

    def use_settings(self, settings: Settings) -> None:
        """Go on with other settings, but for the map's, and those that are read when the node is configured."""
        self.settings = settings = replace(settings, map=self.settings.map)
        self.inputs.policy = settings.prior_policy()
        self.inputs.line_delay = settings.image.line_delay
        self._follower.state.options = settings.recovery.state
        self._follower.images_come = settings.node.mode != ON_REQUEST
        self.reception.use_settings(settings)
        self.attempts.use_options(settings.localizer)

    def forget_after(self, stamp: int) -> None:
        """Forget what is stamped later than `stamp` (nanoseconds): time went back."""
        self._transforms.forget()
        self.inputs.forget_after(stamp)
        self._follower.lose("time went back", with_priors=False)
        self.report.cross_check.forget()
        self._publishers.forget()

    def _tell_reading(self) -> None:
        """Log what there is to say of how the map's file was read."""
        reading, log = self.engine.renderer.reading, self._node.get_logger()
        said = f"map {self.engine.map_path}: {'; '.join(reading.notes)}"
        if reading.left_out:
            log.warning(said)
        elif reading.notes:
            log.info(said)

    def _use_saved_pose(self) -> None:
        pose = self._pose_file.load() if self.settings.node.track else None
        if pose is not None:
            sigma = self.settings.recovery.state.lost_distance
            self.inputs.start_from(self.settings.prior_policy().saved(pose, sigma))

    def _reload_stale_map(self) -> None:
        """Have the map loaded again where the file of its Gaussians was changed while in use."""
        if self.attempts.stale:
            # Once for each image that is refused for it: where it cannot be loaded now, it is tried again.
            self.attempts.stale = False
            self._node.set_parameters([self._node.get_parameter(PATH)])

    def _report_health(self) -> None:
        self._reload_stale_map()
        mode, last = self.settings.node.mode, self._publishers.last_stamp
        if self.active:
            self._follower.pass_time(mode == CONTINUOUS)
            self._standing.publish()
            self._map_view.look()
        level, reason, missing = OK, "inactive", ""
        if self.active:
            missing = self._graph.look(self.reception.unheard, mode)
            level, reason = self.report.health.assess(
                self.settings.image.timeout, mode != ON_REQUEST, missing or self.reception.no_image
            )
        age = "nan" if last is None else f"{1e-9 * (self._node.get_clock().now().nanoseconds - last):.1f}"
        renderer = self.engine.renderer
        about = {
            "mode": mode,
            "map": self.engine.map_path,
            "map_left_out": str(renderer.reading.left_out),
            "map_notes": "; ".join(renderer.reading.notes),
            "device": renderer.device,
            "answer_age": age,
            "requests_waiting": str(self.attempts.waiting),
            "requests_busy": str(self.attempts.unserved),
            "missing": missing,
        }
        self.report.publish_health(level, reason, about)
