"""Localize a camera in a simulated room, from start to end over ROS.

Builds a room, its Gaussian Splatting map and a bag of photos with rough priors, starts the installed `localizer`, plays
the bag into it, and compares its answers with the truth. Exits with 0 when at least 95 % of the photos are localized
within 1 degree and 2 cm.

    python -m gsfeatloc_ros.tools.demo --matcher xfeat --queries 40
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from ament_index_python.packages import get_package_prefix, get_package_share_directory

from gsfeatloc_ros.client.bag_player import Answer, Topics, play_bag
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import rotation_error_deg, translation_error
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.match import DEFAULT_MATCHER, MATCHERS
from gsfeatloc_ros.render import Renderer, create_renderer
from gsfeatloc_ros.simulate import Room, SimulatedPhoto, cover, simulate_photos, write_bag
from gsfeatloc_ros.simulate.bag import CAMERA_INFO_TOPIC, IMAGE_TOPIC, PRIOR_TOPIC

MAX_ROTATION_ERROR_DEG = 1.0
MAX_TRANSLATION_ERROR = 0.02
MIN_SUCCESS_RATE = 0.95

# A camera of 65 degrees with the barrel distortion of a cheap lens.
_K = [[500.0, 0.0, 322.0], [0.0, 502.0, 236.0], [0.0, 0.0, 1.0]]
_CAMERA = Camera(640, 480, np.array(_K), np.array([-0.28, 0.09, 0.0008, -0.0005, 0.0]))
# Seconds that the localizer may take to leave after SIGINT.
_STOP_TIMEOUT = 10.0
_PICTURE_ROWS = 4
_CAPTION_HEIGHT = 30


@dataclass(frozen=True, eq=False)
class Result:
    """A photo, what the localizer said to it, and how far off the prior and the answer are.

    Attributes:
        prior_error, error: degrees and metres; `error` is NaN without an answer.
    """

    photo: SimulatedPhoto
    answer: Answer
    prior_error: tuple[float, float]
    error: tuple[float, float]

    @property
    def success(self) -> bool:
        return self.error[0] <= MAX_ROTATION_ERROR_DEG and self.error[1] <= MAX_TRANSLATION_ERROR

    @staticmethod
    def of(photo: SimulatedPhoto, answer: Answer) -> Result:
        error = (float("nan"), float("nan"))
        if answer.T_map_camera is not None:
            error = _pose_error(photo.T_map_camera, answer.T_map_camera)
        return Result(photo, answer, _pose_error(photo.T_map_camera, photo.T_map_camera_prior), error)

    def row(self, number: int) -> str:
        """A line of the table."""
        prior = f"{number:5d}   {self.prior_error[0]:5.1f} deg {self.prior_error[1]:5.2f} m"
        if self.answer.T_map_camera is None:
            return f"{prior}   no answer: {self.answer.evidence.get('reason', 'none came in time')}"
        final = f"{self.error[0]:6.3f} deg {100 * self.error[1]:6.2f} cm"
        return f"{prior}   {final}   {self.answer.evidence['inliers']:>7}   {self.answer.milliseconds:5.0f}"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demo; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("demo_output"), help="folder of the results (%(default)s)")
    parser.add_argument("--queries", type=int, default=40, help="number of photos (%(default)s)")
    parser.add_argument(
        "--matcher", choices=sorted(MATCHERS), default=DEFAULT_MATCHER, help="of features (%(default)s)"
    )
    args = parser.parse_args(argv)
    if args.queries < 1:
        parser.error("--queries must be at least 1")

    args.out.mkdir(parents=True, exist_ok=True)
    room = Room()
    room_map = cover(room)
    map_file, bag, log = args.out / "room.ply", args.out / "bag", args.out / "localizer.log"
    write_ply(map_file, room_map)
    print(f"map: {len(room_map)} Gaussians cover the room, in {map_file}", flush=True)
    photos = simulate_photos(room, _CAMERA, args.queries)
    shutil.rmtree(bag, ignore_errors=True)
    write_bag(bag, _CAMERA, photos)
    print(f"bag: {len(photos)} photos with priors, in {bag}", flush=True)

    _isolate_ros()
    results = []
    try:
        with running_localizer(map_file, args.matcher, log) as process:
            print(f"localizer: started with {args.matcher}, its log in {log}\n", flush=True)
            print("photo         prior error          final error   inliers      ms", flush=True)
            topics = Topics(IMAGE_TOPIC, CAMERA_INFO_TOPIC, PRIOR_TOPIC)
            answers = play_bag(bag, topics, is_running=lambda: process.poll() is None)
            for number, (photo, answer) in enumerate(zip(photos, answers, strict=True), start=1):
                results.append(Result.of(photo, answer))
                print(results[-1].row(number), flush=True)
    except (RuntimeError, TimeoutError) as error:
        print(f"demo: {error}; see {log}", file=sys.stderr)
        return 1

    picture = args.out / "photos.png"
    cv2.imwrite(str(picture), draw_results(results, room_map)[:, :, ::-1])
    print(f"\nphoto | render at the prior | render at the estimate: {picture}")
    print(summary(results))
    return 0 if sum(result.success for result in results) >= MIN_SUCCESS_RATE * len(results) else 1


@contextmanager
def running_localizer(map_file: Path, matcher: str, log: Path) -> Iterator[subprocess.Popen]:
    """The installed executable in a process of its own, ended on leaving; what it prints goes to the file `log`."""
    executable = Path(get_package_prefix("gsfeatloc_ros")) / "lib" / "gsfeatloc_ros" / "localizer"
    parameters = {"map.path": map_file.resolve(), "matcher.name": matcher}
    remaps = {"image": IMAGE_TOPIC, "camera_info": CAMERA_INFO_TOPIC, "prior": PRIOR_TOPIC}
    command = [str(executable), "--ros-args"]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={value}"]
    for name, topic in remaps.items():
        command += ["-r", f"{name}:={topic}"]
    with log.open("w") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(_STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _isolate_ros() -> None:
    """Let this process and its children talk to each other over ROS and to nobody else, images included."""
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    profile = Path(get_package_share_directory("gsfeatloc_ros")) / "config" / "fastdds.xml"
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))


def _pose_error(truth: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
    """Degrees and metres between two poses (4, 4)."""
    return rotation_error_deg(truth, pose), translation_error(truth, pose)


def summary(results: Sequence[Result]) -> str:
    """The last line: how many were localized, and how well."""
    successes = sum(result.success for result in results)
    counted = (
        f"localized {successes} of {len(results)} ({100 * successes / len(results):.0f} %) "
        f"within {MAX_ROTATION_ERROR_DEG:g} degree and {100 * MAX_TRANSLATION_ERROR:g} cm"
    )
    answered = [
        (*result.error, result.answer.milliseconds) for result in results if result.answer.T_map_camera is not None
    ]
    if not answered:
        return f"{counted}; no answers"
    degrees, metres, milliseconds = np.median(answered, axis=0)
    return f"{counted}; median error {degrees:.2f} degrees, {100 * metres:.1f} cm; median {milliseconds:.0f} ms"


def draw_results(results: Sequence[Result], room_map: GaussianMap) -> np.ndarray:
    """A sheet (H, W, 3) uint8 RGB of some photos: photo | render at the prior | render at the estimate."""
    renderer = create_renderer(room_map)
    chosen = np.unique(np.linspace(0, len(results) - 1, _PICTURE_ROWS).round().astype(int))
    return np.vstack([_draw_result(number + 1, results[number], renderer) for number in chosen])


def _draw_result(number: int, result: Result, renderer: Renderer) -> np.ndarray:
    photo, pose = result.photo, result.answer.T_map_camera
    # Renders are of a pinhole camera: without its distortion the photo can be compared with them.
    undistorted = _CAMERA.undistort_image(photo.image)
    at_prior = renderer.render(_CAMERA, photo.T_map_camera_prior).image()
    if pose is None:
        at_estimate, words = np.zeros_like(undistorted), "no answer"
    else:
        at_estimate = renderer.render(_CAMERA, pose).image()
        words = f"render at the estimate: {result.error[0]:.2f} deg, {100 * result.error[1]:.1f} cm off"
    prior_words = f"render at the prior: {result.prior_error[0]:.0f} deg, {result.prior_error[1]:.2f} m off"
    panels = [
        _captioned(undistorted, f"photo {number} (undistorted)"),
        _captioned(at_prior, prior_words),
        _captioned(at_estimate, words),
    ]
    return np.hstack(panels)


def _captioned(image: np.ndarray, words: str) -> np.ndarray:
    """The image with a caption above and a margin around."""
    framed = cv2.copyMakeBorder(image, _CAPTION_HEIGHT, 4, 4, 4, cv2.BORDER_CONSTANT, value=(24, 24, 24))
    cv2.putText(framed, words, (8, 21), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (235, 235, 235), 1, cv2.LINE_AA)
    return framed


if __name__ == "__main__":
    sys.exit(main())
