"""Watch a localizer at work: what it answers, how it serves requests, and what its process holds."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from std_srvs.srv import Trigger

from gsfeatloc_ros.client.client_node import ClientNode
from gsfeatloc_ros.client.flood import FloodProcess
from gsfeatloc_ros.client.messages import (
    camera_info_of,
    pose_matrix,
    pose_with_covariance,
    read_diagnostics,
    rgb_image,
    stamp_of,
)
from gsfeatloc_ros.client.robot import PHOTOS, Drift, Stream, camera_of
from gsfeatloc_ros.client.score import pose_error
from gsfeatloc_ros.node.qos import LATCHED

try:
    from gsfeatloc_interfaces.srv import LocalizeImage
except ImportError:
    LocalizeImage = None

# Seconds between two calls of services, of which each is called in turn.
_CALL_PERIOD = 3.0
# Seconds that the last reply may take once the stream has ended.
_MAX_WAIT = 5.0
_SAMPLE_PERIOD = 1.0


@dataclass(frozen=True)
class Sample:
    """What the process of the localizer holds.

    Attributes:
        seconds: since the start of the stream.
        memory: resident megabytes, of which `heap` are not shared.
        heap: see there.
        threads: number of them.
        files: number of open file descriptors.
        cpu: seconds used up to then.
    """

    seconds: float
    memory: float
    heap: float
    threads: int
    files: int
    cpu: float

    @staticmethod
    def of(pid: int, seconds: float) -> Sample:
        """Read it from /proc."""
        process = Path(f"/proc/{pid}")
        lines = (line.split(":") for line in (process / "status").read_text().splitlines())
        status = {name: value.split()[0] for name, value in lines if value.split()}
        ticks = (process / "stat").read_text().rsplit(")", 1)[1].split()[11:13]
        return Sample(
            round(seconds, 2),
            int(status["VmRSS"]) / 1024,
            int(status["RssAnon"]) / 1024,
            int(status["Threads"]),
            len(os.listdir(process / "fd")),
            sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK"),
        )


@dataclass(frozen=True)
class Call:
    """A request to a service, and how it was answered.

    Attributes:
        latency: milliseconds from sending the request until the answer was there.
        work: milliseconds of the localization itself; NaN where the service does not say.
        success: whether there was a pose.
    """

    latency: float
    work: float
    success: bool


@dataclass
class SoakRecord:
    """All that was seen.

    Attributes:
        sent: true poses (4, 4) of the stream's images by their stamps.
        answers: poses that were published for them.
        errors: degrees and metres of the poses that a service answered.
        statuses: how many attempts ended so.
        milliseconds: of every localization.
        latencies: milliseconds from the stamps of the stream's images to their poses, as the localizer tells them.
        searches: number of those that had to look from other places than the prior.
        counts: of images, as the localizer told them last.
        calls: to services by their names.
        unanswered: number of those that got no answer; none was made after that.
        samples: of the localizer's process.
    """

    sent: dict[str, np.ndarray] = field(default_factory=dict)
    answers: dict[str, np.ndarray] = field(default_factory=dict)
    errors: list[tuple[float, float]] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    milliseconds: list[float] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)
    searches: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    calls: dict[str, list[Call]] = field(default_factory=dict)
    unanswered: int = 0
    samples: list[Sample] = field(default_factory=list)


class Observer(ClientNode):
    """Listens to the robot and the localizer, and calls the services of the localizer.

    Args:
        photos_file: of prepare_room(); requests carry these photos.
        stream: of the robot.
        calls: whether to call the services.
    """

    def __init__(self, photos_file: Path, stream: Stream, calls: bool = True) -> None:
        super().__init__("observer")
        self.record = SoakRecord()
        self.node.create_subscription(PoseStamped, "ground_truth", self._on_truth, 100)
        self.node.create_subscription(PoseWithCovarianceStamped, "pose", self._on_pose, LATCHED)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._calls: list[Callable[[], None]] = [self._relocalize] if calls else []
        self._relocalize_client = self.node.create_client(Trigger, "localizer/relocalize")
        if calls and LocalizeImage is not None:
            self._photos, self._info = np.load(photos_file, mmap_mode="r"), camera_info_of(camera_of(stream.size))
            self._poses, self._drift = stream.true_poses(), Drift(1)
            self._localize_client = self.node.create_client(LocalizeImage, "localizer/localize_image")
            self._calls.append(self._localize_image)
        self._due, self._called = 0.0, 0
        self._future: rclpy.Future | None = None

    def watch(self, pid: int, robot: BaseProcess, floods: Sequence[FloodProcess] = ()) -> None:
        """Take all in until the robot and the floods have ended and the last request is answered.

        Args:
            pid: of the localizer's process.
            robot: that was started.
            floods: to be sent meanwhile.
        """
        self.spin_until(lambda: bool(self.record.sent) or not robot.is_alive(), float("inf"))
        start, next_sample = time.monotonic(), 0.0
        self._due = start + _CALL_PERIOD
        over = False
        while robot.is_alive() or not over:
            seconds = time.monotonic() - start
            # Each of them, also when one is not over.
            over = sum(not flood.step(seconds) for flood in floods) == 0
            if seconds >= next_sample:
                self.record.samples.append(Sample.of(pid, seconds))
                next_sample += _SAMPLE_PERIOD
            if self._calls and self._future is None and time.monotonic() >= self._due:
                self._calls[self._called % len(self._calls)]()
                self._called += 1
            self.spin_once()
        answered = self.spin_until(lambda: self._future is None, _MAX_WAIT)
        self.record.unanswered = int(not answered)

    def _relocalize(self) -> None:
        self._send("relocalize", self._relocalize_client, Trigger.Request(), lambda answer: (np.nan, answer.success))

    def _localize_image(self) -> None:
        index = self._called % PHOTOS
        request = LocalizeImage.Request(image=rgb_image(self._photos[index]), camera_info=self._info, has_prior=True)
        request.image.header.stamp = self.node.get_clock().now().to_msg()
        request.prior = pose_with_covariance(self._drift.add_to(self._poses[index]))

        def take(answer: LocalizeImage.Response) -> tuple[float, bool]:
            localized = answer.status == answer.LOCALIZED
            if localized:
                self.record.errors.append(pose_error(self._poses[index], pose_matrix(answer.pose)))
            return answer.milliseconds, localized

        self._send("localize_image", self._localize_client, request, take)

    def _send(
        self, name: str, client: rclpy.client.Client, request: Any, take: Callable[[Any], tuple[float, bool]]
    ) -> None:
        """Send a request; `take` returns the work and the success of its answer."""
        sent = time.monotonic()

        def on_answer(future: rclpy.Future) -> None:
            latency = 1e3 * (time.monotonic() - sent)
            self.record.calls.setdefault(name, []).append(Call(latency, *take(future.result())))
            self._future, self._due = None, sent + _CALL_PERIOD

        self._future = client.call_async(request)
        self._future.add_done_callback(on_answer)

    def _on_truth(self, message: PoseStamped) -> None:
        self.record.sent[stamp_of(message)] = pose_matrix(message)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self.record.answers[stamp_of(message)] = pose_matrix(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for diagnostic in read_diagnostics(message):
            values = diagnostic.values
            if "images_received" in values:
                self.record.counts = {name: int(values[name]) for name in ("images_received", "images_dropped")}
            if diagnostic.name == "localizer: localization" and "stamp" in values:
                self.record.statuses[values["status"]] += 1
                if "latency_ms" in values:
                    self.record.latencies.append(float(values["latency_ms"]))
                if "ms_total" in values:
                    self.record.milliseconds.append(float(values["ms_total"]))
                    self.record.searches += values["views"] != "0"
