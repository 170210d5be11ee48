"""Let the installed localizer work for minutes on a camera's stream, and measure how it bears it.

A process of its own publishes photos of the simulated room with real-time stamps, their camera_info, and priors that
are off as a robot's odometry is. Meanwhile the services are called every few seconds. Exits with 1 if a target fails.

    python test/soak.py --seconds 600 --size 1920x1080 --rate 10 --folder /tmp/soak --json soak.json
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from array import array
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path

import numpy as np
import rclpy
from ament_index_python.packages import get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from node_harness import info_of, matrix_of, prior_of, running_localizer, text
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, rotation_error_deg, so3_exp, translation_error
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.ros_io.decode import decode_pose
from gsfeatloc_ros.simulate import Room, cover
from gsfeatloc_ros.simulate.photos import Walk
from gsfeatloc_ros.simulate.room_camera import RoomCamera

try:
    from gsfeatloc_interfaces.srv import LocalizeImage
except ImportError:
    LocalizeImage = None

# Photos of the walk, and seconds of it between two. They are sent there and back again.
PHOTOS = 40
PHOTO_INTERVAL = 0.25
# Standard deviations of the priors' errors along and about each axis, and the share of an error that the next keeps.
PRIOR_METRES, PRIOR_DEGREES, PRIOR_KEPT = 0.15, 5.0, 0.95
# Seconds between two calls of services, of which each is called in turn.
CALL_PERIOD = 3.0
# Seconds that the last answer may take once the stream has ended.
PATIENCE = 5.0
# Seconds after which memory is not to grow any more.
WARM_UP = 60.0
# Blocks of time that are compared by their memory.
BLOCKS = 12
# The targets.
MAX_DEGREES, MAX_METRES = 1.0, 0.02
MIN_RECEPTION = 0.95
# Of the answer to a request, in times of a localization.
MAX_LATENCY = 1.5
# Megabytes a minute, and megabytes in all as a share, by which memory may seem to grow.
MAX_GROWTH, MAX_STEPS = 0.1, 0.05


def camera_of(size: tuple[int, int]) -> Camera:
    """A camera of 65 degrees with the barrel distortion of a cheap lens, `size` its width and height in pixels."""
    width, height = size
    K = [[0.78 * width, 0.0, 0.503 * width], [0.0, 0.784 * width, 0.492 * height], [0.0, 0.0, 1.0]]
    return Camera(width, height, np.array(K), np.array([-0.28, 0.09, 0.0008, -0.0005, 0.0]))


def truth() -> np.ndarray:
    """T_map_camera (PHOTOS, 4, 4) of the photos."""
    walk = Walk(np.random.default_rng(0).uniform(0, 2 * np.pi, 4))
    return np.array([walk.pose(index * PHOTO_INTERVAL) for index in range(PHOTOS)])


@cache
def simulated_camera(size: tuple[int, int]) -> RoomCamera:
    return RoomCamera(Room(seed=0), camera_of(size))


def take_photo(size: tuple[int, int], index: int) -> np.ndarray:
    """Photo (H, W, 3) number `index`, of a camera that stands still."""
    pose, rng = truth()[index], np.random.default_rng(index)
    return simulated_camera(size).photo(lambda time: pose, 0.0, rng)


def prepare(folder: Path, size: tuple[int, int]) -> tuple[Path, Path]:
    """Files of the map and of the photos (PHOTOS, H, W, 3), made if they are not there."""
    folder.mkdir(parents=True, exist_ok=True)
    map_file, photos_file = folder / "room.ply", folder / f"photos_{size[0]}x{size[1]}.npy"
    if not map_file.exists():
        write_ply(map_file, cover(Room(seed=0)))
    if not photos_file.exists():
        print(f"taking {PHOTOS} photos, kept in {photos_file}", flush=True)
        with multiprocessing.get_context("spawn").Pool() as pool:
            np.save(photos_file, pool.map(partial(take_photo, size), range(PHOTOS), chunksize=1))
    return map_file, photos_file


def image_of(photo: np.ndarray) -> Image:
    height, width = photo.shape[:2]
    header = Header(frame_id="camera_optical")
    data = array("B", photo.tobytes())
    return Image(header=header, height=height, width=width, encoding="rgb8", step=3 * width, data=data)


class Drift:
    """Errors of a robot's odometry that is corrected now and then: they wander, but not away."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._sigmas = np.array([PRIOR_METRES] * 3 + [np.radians(PRIOR_DEGREES)] * 3)
        self._error = self._sigmas * self._rng.standard_normal(6)

    def add_to(self, pose: np.ndarray) -> np.ndarray:
        """The pose (4, 4) as odometry has it."""
        fresh = np.sqrt(1 - PRIOR_KEPT**2) * self._sigmas * self._rng.standard_normal(6)
        self._error = PRIOR_KEPT * self._error + fresh
        return make_pose(pose[:3, :3] @ so3_exp(self._error[3:]), pose[:3, 3] + self._error[:3])


def publish(photos_file: Path, size: tuple[int, int], rate: float, seconds: float) -> None:
    """The robot, in a process of its own: its camera and its odometry."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("robot", context=context)
    image = node.create_publisher(Image, "image", qos_profile_sensor_data)
    camera_info = node.create_publisher(CameraInfo, "camera_info", qos_profile_sensor_data)
    prior = node.create_publisher(PoseStamped, "prior", 5)
    ground_truth = node.create_publisher(PoseStamped, "ground_truth", 100)
    images, info, poses, drift = list(map(image_of, np.load(photos_file))), info_of(camera_of(size)), truth(), Drift(0)
    there_and_back = [*range(PHOTOS), *range(PHOTOS - 2, 0, -1)]
    publishers = (image, camera_info, prior, ground_truth)
    while not all(publisher.get_subscription_count() for publisher in publishers):
        time.sleep(0.1)
    start = time.monotonic()
    for number in range(int(seconds * rate)):
        time.sleep(max(0.0, start + number / rate - time.monotonic()))
        index, stamp = there_and_back[number % len(there_and_back)], node.get_clock().now().to_msg()
        for publisher, message in (
            (ground_truth, prior_of(poses[index])),
            (camera_info, info),
            (prior, prior_of(drift.add_to(poses[index]))),
            (image, images[index]),
        ):
            message.header.stamp = stamp
            publisher.publish(message)
    # What is reliable is to arrive.
    time.sleep(2.0)
    node.destroy_node()
    rclpy.shutdown(context=context)


@dataclass(frozen=True)
class Sample:
    """What the localizer's process holds.

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
    """A request to a service: milliseconds until its answer, and how it was answered.

    Attributes:
        latency: milliseconds from sending the request until the answer was there.
        work: milliseconds of the localization itself; NaN where the service does not say.
        success: whether there was a pose.
    """

    latency: float
    work: float
    success: bool


def error_of(pose: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Degrees and metres between two poses (4, 4)."""
    return rotation_error_deg(pose, truth), translation_error(pose, truth)


@dataclass
class Record:
    """All that was seen.

    Attributes:
        sent: true poses (4, 4) of the stream's images by their stamps.
        answers: poses that were published for them.
        errors: degrees and metres of the poses that a service answered.
        statuses: how many attempts ended so.
        milliseconds: of every localization.
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
    searches: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    calls: dict[str, list[Call]] = field(default_factory=dict)
    unanswered: int = 0
    samples: list[Sample] = field(default_factory=list)


class Observer:
    """Listens to robot and localizer, and calls the localizer's services."""

    def __init__(self, photos_file: Path, size: tuple[int, int]) -> None:
        self.record = Record()
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = node = rclpy.create_node("observer", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(PoseStamped, "ground_truth", self._on_truth, 100)
        node.create_subscription(PoseWithCovarianceStamped, "pose", self._on_pose, latched)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        self._calls: list[Callable[[], None]] = [self._relocalize]
        self._relocalize_client = node.create_client(Trigger, "localizer/relocalize")
        if LocalizeImage is not None:
            self._photos, self._info = np.load(photos_file, mmap_mode="r"), info_of(camera_of(size))
            self._poses, self._drift = truth(), Drift(1)
            self._localize_client = node.create_client(LocalizeImage, "localizer/localize_image")
            self._calls.append(self._localize_image)
        self._due, self._future, self._called = 0.0, None, 0

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def watch(self, pid: int, robot: multiprocessing.Process) -> None:
        """Until the robot has ended, and the last request is answered."""
        while not self.record.sent and robot.is_alive():
            self._executor.spin_once(timeout_sec=0.1)
        start, next_sample = time.monotonic(), 0.0
        self._due = start + CALL_PERIOD
        while robot.is_alive():
            seconds = time.monotonic() - start
            if seconds >= next_sample:
                self.record.samples.append(Sample.of(pid, seconds))
                next_sample += 1.0
            if self._future is None and time.monotonic() >= self._due:
                self._calls[self._called % len(self._calls)]()
                self._called += 1
            self._executor.spin_once(timeout_sec=0.05)
        deadline = time.monotonic() + PATIENCE
        while self._future is not None and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.05)
        self.record.unanswered = int(self._future is not None)

    def _relocalize(self) -> None:
        self._send("relocalize", self._relocalize_client, Trigger.Request(), lambda answer: (np.nan, answer.success))

    def _localize_image(self) -> None:
        index = self._called % PHOTOS
        request = LocalizeImage.Request(image=image_of(self._photos[index]), camera_info=self._info, has_prior=True)
        request.image.header.stamp = self._node.get_clock().now().to_msg()
        prior = prior_of(self._drift.add_to(self._poses[index]))
        request.prior.header, request.prior.pose.pose = prior.header, prior.pose

        def took(answer: LocalizeImage.Response) -> tuple[float, bool]:
            localized = answer.status == answer.LOCALIZED
            if localized:
                self.record.errors.append(error_of(matrix_of(answer.pose), self._poses[index]))
            return answer.milliseconds, localized

        self._send("localize_image", self._localize_client, request, took)

    def _send(
        self, name: str, client: rclpy.client.Client, request: object, took: Callable[[object], tuple[float, bool]]
    ) -> None:
        sent = time.monotonic()

        def on_answer(future: rclpy.Future) -> None:
            latency = 1e3 * (time.monotonic() - sent)
            self.record.calls.setdefault(name, []).append(Call(latency, *took(future.result())))
            self._future, self._due = None, sent + CALL_PERIOD

        self._future = client.call_async(request)
        self._future.add_done_callback(on_answer)

    def _on_truth(self, message: PoseStamped) -> None:
        self.record.sent[text(message)] = decode_pose(message, "truth")

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        self.record.answers[text(message)] = matrix_of(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            if "images_received" in values:
                self.record.counts = {name: int(values[name]) for name in ("images_received", "images_dropped")}
            if status.name == "localizer: localization" and "stamp" in values:
                self.record.statuses[values["status"]] += 1
                if "ms_total" in values:
                    self.record.milliseconds.append(float(values["ms_total"]))
                    self.record.searches += values["views"] != "0"


def growth(samples: list[Sample]) -> float:
    """How fast memory grows all the time, in megabytes a minute.

    The median of the rises between the medians of blocks of time: a leak makes most of them rise. The allocator's
    steps to another high-water mark, at the first far prior for instance, make a few rise; MAX_STEPS is the bound of
    those. Single samples depend on what was localized just then.
    """
    blocks = np.array_split(np.array([(sample.seconds / 60, sample.memory) for sample in samples]), BLOCKS)
    minutes, medians = np.array([np.median(block, axis=0) for block in blocks]).T
    return float(np.median(np.diff(medians) / np.diff(minutes)))


def last_rise(samples: list[Sample]) -> float:
    """Second at which memory came within a megabyte of the most that it was."""
    most = max(sample.memory for sample in samples)
    return next(sample.seconds for sample in samples if sample.memory > most - 1.0)


def summarize_calls(calls: list[Call], typical: float) -> dict[str, float]:
    """Latencies of a service, also as multiples of a `typical` localization (milliseconds) and of their own."""
    latency, work = np.array([(call.latency, call.work) for call in calls]).T
    figures = {
        "ms_median": np.median(latency),
        "ms_max": np.max(latency),
        "times_median": np.median(latency) / typical,
        "times_95_percent": np.percentile(latency, 95) / typical,
        "times_max": np.max(latency) / typical,
    }
    if not np.isnan(work).any():
        # Beyond the localization itself: waiting, and the way there and back.
        beside = {"ms_beside_work_median": np.median(latency - work), "ms_beside_work_max": np.max(latency - work)}
        figures |= beside | {"times_own_work_95_percent": np.percentile(latency / work, 95)}
    counts = {"calls": len(calls), "with_pose": sum(call.success for call in calls)}
    return counts | {name: round(float(value), 2) for name, value in figures.items()}


def summarize(record: Record, seconds: float) -> dict:
    """What is to be told, and whether the targets were reached."""
    of_stream = [error_of(pose, record.sent[stamp]) for stamp, pose in record.answers.items()]
    degrees, metres = np.array(of_stream + record.errors).T
    wrong = int(((degrees > MAX_DEGREES) | (metres > MAX_METRES)).sum())
    sent, received = len(record.sent), record.counts["images_received"]
    typical = float(np.median(record.milliseconds))
    warm_up = min(WARM_UP, seconds / 3)
    late = [sample for sample in record.samples if sample.seconds >= warm_up]
    warm, last = late[0], late[-1]
    leak = growth(late)
    services = {name: summarize_calls(calls, typical) for name, calls in record.calls.items()}
    return {
        "seconds": seconds,
        "images_sent": sent,
        "images_received": received,
        "reception": round(received / sent, 4),
        "images_dropped": record.counts["images_dropped"],
        "attempts": dict(record.statuses),
        "searches": record.searches,
        "answers": len(degrees),
        "answers_wrong": wrong,
        "error_degrees_median": round(float(np.median(degrees)), 4),
        "error_degrees_max": round(float(np.max(degrees)), 4),
        "error_metres_median": round(float(np.median(metres)), 5),
        "error_metres_max": round(float(np.max(metres)), 5),
        "localization_ms_median": typical,
        "localization_ms_95_percent": round(float(np.percentile(record.milliseconds, 95)), 1),
        "worker_busy": round(sum(record.milliseconds) / 1e3 / last.seconds, 3),
        "services": services,
        "services_unanswered": record.unanswered,
        "memory_mb_after_warm_up": round(warm.memory, 1),
        "memory_mb_end": round(last.memory, 1),
        "memory_mb_per_minute": round(leak, 3),
        "memory_last_rise_second": last_rise(late),
        "heap_mb_after_warm_up": round(warm.heap, 1),
        "heap_mb_end": round(last.heap, 1),
        "threads": [warm.threads, last.threads],
        "files": [warm.files, last.files],
        "cpu_seconds": round(last.cpu - record.samples[0].cpu, 1),
        "targets": {
            "memory does not grow": leak <= MAX_GROWTH
            and last.memory <= (1 + MAX_STEPS) * warm.memory
            and last.threads <= warm.threads
            and last.files <= warm.files,
            "every answer is right": wrong == 0,
            "images are received": received >= MIN_RECEPTION * sent,
            "services answer in time": record.unanswered == 0
            and all(
                max(service["times_median"], service.get("times_own_work_95_percent", 0.0)) < MAX_LATENCY
                for service in services.values()
            ),
        },
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the soak; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--seconds", type=float, default=600, help="how long (%(default)g); memory still settles before 300"
    )
    parser.add_argument("--size", default="640x480", help="of the images in pixels (%(default)s)")
    parser.add_argument("--rate", type=float, default=10.0, help="images a second (%(default)g)")
    parser.add_argument("--folder", type=Path, default="soak", help="keeps the map and the photos (%(default)s)")
    parser.add_argument("--json", type=Path, help="file of the results")
    args = parser.parse_args(argv)
    size = tuple(int(side) for side in args.size.split("x"))
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    profile = Path(get_package_share_directory("gsfeatloc_ros")) / "config" / "fastdds.xml"
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))

    map_file, photos_file = prepare(args.folder, size)
    robot = multiprocessing.get_context("spawn").Process(
        target=publish, args=(photos_file, size, args.rate, args.seconds)
    )
    observer = Observer(photos_file, size)
    try:
        with running_localizer(map__path=map_file) as localizer:
            robot.start()
            observer.watch(localizer.pid, robot)
    finally:
        observer.close()
        robot.terminate()
    if not (observer.record.answers and observer.record.calls):
        print("soak: the localizer gave no pose, or answered no request", file=sys.stderr)
        return 1
    result = {"size": args.size, "rate": args.rate} | summarize(observer.record, args.seconds)
    print(json.dumps(result, indent=2))
    if args.json:
        samples = [vars(sample) for sample in observer.record.samples]
        calls = {name: [vars(call) for call in calls] for name, calls in observer.record.calls.items()}
        args.json.write_text(json.dumps(result | {"samples": samples, "calls": calls}, indent=1))
    return 0 if all(result["targets"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
