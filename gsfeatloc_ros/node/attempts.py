"""The worker's jobs: localize an image, publish the answer, report how it ended."""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from threading import Lock

from geometry_msgs.msg import PoseArray
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.index import ViewIndex
from gsfeatloc_ros.localize.engine import Engine
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.node.diagnostics import prior_texts, protection_texts
from gsfeatloc_ros.node.pose_file import PoseFile
from gsfeatloc_ros.node.publishers import Answer, Publishers
from gsfeatloc_ros.node.report import Report
from gsfeatloc_ros.node.standing import StandingPublisher
from gsfeatloc_ros.node.worker import QueueLimits, Terms, Worker
from gsfeatloc_ros.render import StaleMapError
from gsfeatloc_ros.ros_io.extrinsics import Extrinsics
from gsfeatloc_ros.ros_io.follower import Follower
from gsfeatloc_ros.ros_io.inputs import LocalizerInput, NewestInputs
from gsfeatloc_ros.ros_io.outcome import Outcome
from gsfeatloc_ros.ros_io.prior import Prior
from gsfeatloc_ros.ros_io.settings import RequestSettings
from gsfeatloc_ros.ros_io.state import Decision, State


@dataclass(frozen=True, eq=False)
class Job:
    """An image to localize.

    Attributes:
        message: the image.
        camera: of the image; None for that of the newest camera_info.
        prior: where it was taken; None for the newest.
        inputs: the newest camera_info and prior when it was asked for; None for those when the work on it begins.
        shared: whether the answer is for all, on the topics, or only for the one who asks.
        kept: whether, asked for by one alone, it is gone on from all the same.
        max_seconds: after which it ends with what it has; 0 for what the options say.
    """

    message: Image | CompressedImage
    camera: Camera | None = None
    prior: Prior | None = None
    inputs: NewestInputs | None = None
    shared: bool = True
    kept: bool = True
    max_seconds: float = 0.0

    def same(self, other: Job) -> bool:
        """Return whether this is the same image, asked for with the same camera_info and prior; if it is for all.

        One that is worked on anyway counts as well, with the newest that there were when that began.
        """
        if not (self.shared and other.shared and self.message is other.message):
            return False
        a, b = self.inputs, other.inputs
        return a is None or b is None or (a.camera is b.camera and a.prior is b.prior)


@dataclass(frozen=True, eq=False)
class JobResult:
    """What came of a job.

    Attributes:
        outcome: of the image.
        answer: as it is published; None unless localized.
        candidates: poses that explain the image about equally well, if that is why there is no answer.
        prior: what is known of the prior, by key.
        latency: seconds from the image's stamp to the pose; NaN where none was published, or it has no stamp.
    """

    outcome: Outcome
    answer: Answer | None = None
    candidates: PoseArray | None = None
    prior: dict[str, str] = field(default_factory=dict)
    latency: float = math.nan


@dataclass(frozen=True, eq=False)
class Outputs:
    """Where what came of an image goes.

    Attributes:
        publishers: of the answers that are for all.
        standing: says where the robot stands.
        pose_file: keeps the last good pose.
        report: of how it goes.
    """

    publishers: Publishers
    standing: StandingPublisher
    pose_file: PoseFile
    report: Report


class Attempts:
    """Localizes images one after the other, in a thread of its own; its methods may be called from another.

    Args:
        engine: that localizes.
        follower: says what images start from, and which answers are gone on from.
        outputs: where the answers go.

    Attributes:
        publishing: whether answers are published, even those that are for all.
        stale: whether the map has to be loaded again: its file was changed.
    """

    def __init__(self, engine: Engine, follower: Follower, outputs: Outputs) -> None:
        self._engine, self._follower, self._outputs = engine, follower, outputs
        self._engine_lock = Lock()
        self.publishing = self.stale = False
        self._worker: Worker[Job, JobResult] = Worker(self._attempt, Job.same)

    @property
    def engine(self) -> Engine:
        """The engine that localizes."""
        return self._engine

    @property
    def dropped(self) -> int:
        """Number of images that gave way to a newer one or to a request."""
        return self._worker.dropped

    def offer(self, job: Job) -> None:
        """Do a job when nothing is requested, unless a newer one is offered by then."""
        self._worker.offer(job)

    @property
    def silent_seconds(self) -> float:
        """For how long the running localization has shown no sign of life; 0 for none."""
        return self._worker.silent_seconds

    @property
    def waiting(self) -> int:
        """Number of requests that wait."""
        return self._worker.waiting

    @property
    def unserved(self) -> int:
        """Number of requests that were told that it is busy."""
        return self._worker.unserved

    def request(self, job: Job, settings: RequestSettings, wanted: Callable[[], bool]) -> Future[JobResult]:
        """Do a job before those that are offered, if there is room in the queue.

        The Future raises UnservedError where it is not done in time, and is cancelled when the worker stops first.

        Args:
            job: to be done.
            settings: of the queue.
            wanted: returns whether anybody waits for it still.
        """
        self._worker.limits = QueueLimits(settings.max_waiting, int(1e6 * settings.max_megabytes))
        # A search may take what it was given on top.
        seconds = settings.timeout + (job.max_seconds or self._engine.options.search.max_seconds)
        return self._worker.request(job, Terms(len(job.message.data), seconds, wanted))

    def drop_late(self) -> None:
        """Tell those whose time is up while they wait."""
        self._worker.drop_late()

    def stop(self, timeout: float) -> bool:
        """Have the running localization given up; return whether it ended within `timeout` seconds."""
        return self._worker.stop(timeout)

    def use_map(self, engine: Engine) -> None:
        """Go on with the map of another engine."""
        with self._engine_lock:
            self._engine = engine.with_options(self._engine.options)
            self.stale = False

    def use_options(self, options: LocalizerOptions) -> None:
        """Go on with other options of the localizer."""
        with self._engine_lock:
            self._engine = self._engine.with_options(options)

    def use_index(self, engine: Engine, index: ViewIndex) -> None:
        """Go on with the view index of an engine's map, if that is still the map in use."""
        with self._engine_lock:
            if self._engine.renderer is engine.renderer:
                self._engine = self._engine.with_index(index)

    # In the worker's thread.

    def _attempt(self, job: Job, interrupted: Callable[[], bool]) -> JobResult:
        """Localize an image, and report once what came of it, whatever happens."""
        stack = ""
        try:
            result = self._localize(job, interrupted)
        except Interrupted:
            raise
        except StaleMapError as error:
            result, self.stale = JobResult(Outcome.refused(error)), True
        except Exception as error:
            # Not foreseen: a bug, or out of memory. The next image may well do.
            result, stack = JobResult(Outcome.error(error)), traceback.format_exc()
        about = result.prior | {"state": self._follower.state.standing().state.value}
        if result.answer:
            about |= protection_texts(result.answer.protection)
        if not math.isnan(result.latency):
            about["latency_ms"] = f"{1e3 * result.latency:.1f}"
        self._outputs.report.publish_attempt(job.message.header.stamp, result.outcome, about, stack)
        return result

    def _localize(self, job: Job, interrupted: Callable[[], bool]) -> JobResult:
        engine, header, publishers = self._engine, job.message.header, self._outputs.publishers
        resets = self._follower.state.resets
        if self._follower.state.standing().state is State.LOST:
            publishers.forget()
        try:
            query = self._follower.for_image(job.message, job.camera, job.prior, job.inputs)
            extrinsics = publishers.extrinsics(header, job.shared)
        except ValueError as error:
            if job.shared and self.publishing:
                publishers.publish_refused(job.message, error)
            return JobResult(Outcome.refused(error))
        localizer = engine.with_options(self._options(engine.options, job, query)).localizer
        trace = localizer.trace(
            query.image, query.camera, query.T_map_camera_prior, query.prior_covariance, interrupted
        )
        if self._engine.renderer is not engine.renderer or self._follower.state.resets != resets:
            return JobResult(Outcome.refused("the map or the state was changed while this image was localized"))
        result = JobResult(
            Outcome.of(trace.estimate),
            publishers.answer(trace.estimate, extrinsics, header),
            publishers.candidates(trace.estimate, extrinsics, header) if trace.estimate.candidates else None,
            prior_texts(query),
        )
        T_map_camera = trace.estimate.T_map_camera
        if job.shared and self.publishing:
            result = self._share(result, query, extrinsics, job.message.header)
            publishers.publish_searched(trace, extrinsics, header)
            publishers.publish_pictures(trace, header)
        elif job.kept and not job.shared and T_map_camera is not None:
            self._follower.take_requested(query, header, T_map_camera)
        return result

    def _options(self, options: LocalizerOptions, job: Job, query: LocalizerInput) -> LocalizerOptions:
        """Return the options for a job, whose image is localized with `query`."""
        options = self._follower.options(options, job.message.header, query)
        if job.max_seconds > 0:
            search = replace(options.search, max_seconds=job.max_seconds)
            options = replace(options, deadline=job.max_seconds, search=search)
        return options

    def _share(self, result: JobResult, query: LocalizerInput, extrinsics: Extrinsics, header: Header) -> JobResult:
        """Publish what came of an image, go on from it, and return what is to be said of it."""
        outputs, estimate = self._outputs, result.outcome.estimate
        assert estimate is not None  # it was tried
        T_map_camera = estimate.T_map_camera
        judgement = self._follower.take(query, header, estimate)
        if judgement.decision is Decision.AWAIT:
            result = replace(result, outcome=Outcome.of(estimate, judgement), answer=None)
        elif result.answer is not None and T_map_camera is not None:
            latency = outputs.publishers.publish_answer(result.answer, T_map_camera, extrinsics)
            outputs.report.count_answer(latency)
            result = replace(result, latency=latency)
            outputs.pose_file.take(T_map_camera)
            if judgement.note:
                outputs.report.note(judgement.note)
                outputs.report.cross_check.forget()
            if estimate.covariance is not None:
                outputs.report.cross_check.take(header, T_map_camera, estimate.covariance)
        elif result.candidates is not None:
            outputs.publishers.publish_candidates(result.candidates)
        outputs.standing.publish_change()
        return result
