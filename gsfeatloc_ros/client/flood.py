"""A flood of requests to a localizer: sent at a rate, or all at once, and how each was answered."""

from __future__ import annotations

import math
import multiprocessing
import time
from collections import Counter
from dataclasses import dataclass
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

import numpy as np
from std_srvs.srv import Trigger

from gsfeatloc_ros.client.client_node import ClientNode
from gsfeatloc_ros.client.messages import camera_info_of, pose_with_covariance, rgb_image
from gsfeatloc_ros.client.robot import PHOTOS, Drift, Stream, camera_of
from gsfeatloc_ros.node.qos import REQUESTS
from gsfeatloc_ros.ros_io.outcome import OutcomeStatus

try:
    from gsfeatloc_interfaces.srv import LocalizeImage
except ImportError:
    LocalizeImage = None

RELOCALIZE, LOCALIZE_IMAGE = "relocalize", "localize_image"
UNANSWERED = "unanswered"

# Seconds that the localizer may need to find the flood after the flood has found it, and that the last reply may take.
_SETTLING = 1.0
_MAX_WAIT = 20.0


@dataclass(frozen=True)
class Flood:
    """Requests that come without waiting for each other.

    Attributes:
        service: RELOCALIZE or LOCALIZE_IMAGE.
        requests: number of them.
        rate: of them a second; 0 for all at once.
        start: second of the stream at which it begins.
    """

    service: str
    requests: int
    rate: float
    start: float


@dataclass(frozen=True)
class FloodReply:
    """What came of a request.

    Attributes:
        sent: seconds since the epoch.
        latency: milliseconds until the answer was there; NaN where none came.
        status: of the answer, or UNANSWERED.
    """

    sent: float
    latency: float
    status: str


class FloodProcess:
    """Sends a flood from a process of its own: sending takes time.

    Attributes:
        flood: that it sends.
        replies: to it, once they were taken in.
    """

    def __init__(self, flood: Flood, photos_file: Path, stream: Stream) -> None:
        self.flood = flood
        self.replies: list[FloodReply] = []
        context = multiprocessing.get_context("spawn")
        self._queue: Queue[list[FloodReply]] = context.Queue()
        self._process = context.Process(target=run_flood, args=(flood, photos_file, stream, self._queue))
        self._started = False

    def step(self, seconds: float) -> bool:
        """Start it when it is time, `seconds` into the stream, take its replies in, and return whether it is over."""
        if not self._started and seconds >= self.flood.start:
            self._started = True
            self._process.start()
        if self._started and not self.replies and not self._queue.empty():
            self.replies = self._queue.get()
        return bool(self.replies) or (self._started and not self._process.is_alive() and self._queue.empty())

    def stop(self) -> None:
        """Make sure that it is gone."""
        if self._started and self._process.is_alive():
            self._process.terminate()


def run_flood(flood: Flood, photos_file: Path, stream: Stream, replies: Queue[list[FloodReply]]) -> None:
    """Send a flood, and put its replies into the queue."""
    client = ClientNode("flood")
    try:
        replies.put(_Sender(client, flood, photos_file, stream).run())
    finally:
        client.close()


def summarize_flood(flood: Flood, replies: list[FloodReply]) -> dict[str, Any]:
    """Return how a flood was answered."""
    busy = [reply.latency for reply in replies if reply.status == OutcomeStatus.BUSY.value]
    served = [reply.latency for reply in replies if reply.status not in (OutcomeStatus.BUSY.value, UNANSWERED)]
    statuses = Counter(reply.status for reply in replies)
    return {
        "service": flood.service,
        "requests": flood.requests,
        "rate": flood.rate,
        "statuses": dict(statuses),
        "unanswered": statuses[UNANSWERED],
        "ms_busy_median": _rounded(np.median, busy),
        "ms_busy_max": _rounded(np.max, busy),
        "ms_served_median": _rounded(np.median, served),
        "ms_served_max": _rounded(np.max, served),
    }


class _Sender:
    def __init__(self, client: ClientNode, flood: Flood, photos_file: Path, stream: Stream) -> None:
        self._client, self._flood = client, flood
        self._replies: list[FloodReply] = []
        service = Trigger if flood.service == RELOCALIZE else LocalizeImage
        # Many answers may come at once, of which none may be lost on this side.
        self._service = client.node.create_client(service, f"localizer/{flood.service}", qos_profile=REQUESTS)
        if flood.service == LOCALIZE_IMAGE:
            self._images = list(map(rgb_image, np.load(photos_file)))
            self._info = camera_info_of(camera_of(stream.size))
            self._poses, self._drift = stream.true_poses(), Drift(2)

    def run(self) -> list[FloodReply]:
        """Send all requests, wait for the replies, and return them."""
        client, flood = self._client, self._flood
        if not client.spin_until(self._service.service_is_ready):
            return []
        client.spin(_SETTLING)
        start, sent = time.monotonic(), []
        for number in range(flood.requests):
            due = start + number / flood.rate if flood.rate else start
            while time.monotonic() < due:
                client.spin_once()
            sent.append(time.time())
            self._send(number, sent[-1])
            # Replies that nobody takes would be lost on the client's side.
            client.spin_once(0.0)
        client.spin_until(lambda: len(self._replies) == flood.requests, _MAX_WAIT)
        answered = {reply.sent for reply in self._replies}
        return self._replies + [FloodReply(at, math.nan, UNANSWERED) for at in sent if at not in answered]

    def _send(self, number: int, sent: float) -> None:
        start = time.monotonic()

        def take(future: Any) -> None:
            latency = 1e3 * (time.monotonic() - start)
            self._replies.append(FloodReply(sent, latency, _status(future.result())))

        self._service.call_async(self._request(number)).add_done_callback(take)

    def _request(self, number: int) -> Any:
        if self._flood.service == RELOCALIZE:
            return Trigger.Request()
        index = number % PHOTOS
        request = LocalizeImage.Request(image=self._images[index], camera_info=self._info, has_prior=True)
        request.image.header.stamp = self._client.node.get_clock().now().to_msg()
        request.prior = pose_with_covariance(self._drift.add_to(self._poses[index]))
        return request


def _status(answer: Any) -> str:
    """Return the status of an answer in words; a Trigger tells little more than whether there was a pose."""
    if isinstance(answer, Trigger.Response):
        if answer.success:
            return OutcomeStatus.LOCALIZED.value
        busy = answer.message.startswith(OutcomeStatus.BUSY.value)
        return OutcomeStatus.BUSY.value if busy else OutcomeStatus.FAILED.value
    return next(status.value for status in OutcomeStatus if getattr(answer, status.name, None) == answer.status)


def _rounded(of: Any, values: list[float]) -> float | None:
    return round(float(of(values)), 1) if values else None
