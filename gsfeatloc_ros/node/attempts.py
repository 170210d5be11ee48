"""The worker's jobs: localize an image, publish the answer, report how it ended."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

from sensor_msgs.msg import CompressedImage, Image

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.localize.engine import Engine
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.node.publishers import Answer, Publishers
from gsfeatloc_ros.node.report import Report
from gsfeatloc_ros.node.worker import Worker
from gsfeatloc_ros.ros_io.decode import nanoseconds
from gsfeatloc_ros.ros_io.inputs import Inputs
from gsfeatloc_ros.ros_io.outcome import Outcome
from gsfeatloc_ros.ros_io.prior import Prior


@dataclass(frozen=True, eq=False)
class Job:
    """An image to localize.

    Attributes:
        message: the image.
        camera: of the image; None for that of the newest camera_info.
        prior: where it was taken; None for the newest.
        shared: whether the answer is for all, on the topics, or only for the one who asks.
    """

    message: Image | CompressedImage
    camera: Camera | None = None
    prior: Prior | None = None
    shared: bool = True


@dataclass(frozen=True, eq=False)
class JobResult:
    """What came of a job.

    Attributes:
        outcome: of the image.
        answer: as it is published; None unless localized.
    """

    outcome: Outcome
    answer: Answer | None = None


class Attempts:
    """Localizes images one after the other, in a thread of its own; its methods may be called from another.

    Args:
        engine: that localizes.
        inputs: what images are localized with.
        publishers: of the answers that are for all.
        report: of how it goes.
        track: whether the next image goes on from an answer.

    Attributes:
        publishing: whether answers are published, even those that are for all.
    """

    def __init__(self, engine: Engine, inputs: Inputs, publishers: Publishers, report: Report, track: bool) -> None:
        self._engine, self._inputs, self._publishers = engine, inputs, publishers
        self._report, self._track = report, track
        self.publishing = False
        self._worker: Worker[Job, JobResult] = Worker(self._attempt)

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

    def request(self, job: Job) -> Future[JobResult]:
        """Do a job in any case, before all that is offered; the Future is cancelled when the worker stops first."""
        return self._worker.request(job)

    def stop(self, timeout: float) -> bool:
        """Have the running localization given up; return whether it ended within `timeout` seconds."""
        return self._worker.stop(timeout)

    def use_map(self, engine: Engine) -> None:
        """Go on with the map of another engine."""
        self._engine = engine.with_options(self._engine.options)

    def use_options(self, options: LocalizerOptions) -> None:
        """Go on with other options of the localizer."""
        self._engine = self._engine.with_options(options)

    # In the worker's thread.

    def _attempt(self, job: Job, interrupted: Callable[[], bool]) -> JobResult:
        """Localize an image, and report once what came of it, whatever happens."""
        stack = ""
        try:
            result = self._localize(job, interrupted)
        except Interrupted:
            raise
        except Exception as error:
            # Not foreseen: a bug, or out of memory. The next image may well do.
            result, stack = JobResult(Outcome.error(error)), traceback.format_exc()
        protection = result.answer.protection if result.answer else None
        self._report.publish_attempt(job.message.header.stamp, result.outcome, protection, stack)
        return result

    def _localize(self, job: Job, interrupted: Callable[[], bool]) -> JobResult:
        engine, header = self._engine, job.message.header
        try:
            query = self._inputs.for_image(job.message, job.camera, job.prior)
            extrinsics = self._publishers.extrinsics(header, job.shared)
        except ValueError as error:
            if job.shared and self.publishing:
                self._publishers.publish_refused(job.message, str(error))
            return JobResult(Outcome.refused(error))
        trace = engine.localizer.trace(
            query.image, query.camera, query.T_map_camera_prior, query.prior_covariance, interrupted
        )
        if self._engine.renderer is not engine.renderer:
            return JobResult(Outcome.refused("the map was changed while this image was localized: send another"))
        outcome, T_map_camera = Outcome.of(trace.estimate), trace.estimate.T_map_camera
        answer = self._publishers.answer(trace.estimate, extrinsics, header)
        if job.shared:
            self._report.camera.take(query.camera, trace.estimate)
        if job.shared and self.publishing:
            if answer is not None and T_map_camera is not None:
                self._report.count_answer()
                self._publishers.publish_answer(answer, T_map_camera, extrinsics)
                if self._track:
                    self._inputs.take_answer(T_map_camera, nanoseconds(header.stamp), query.prior)
            self._publishers.publish_pictures(trace, header)
        return JobResult(outcome, answer)
