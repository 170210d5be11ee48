"""A SLAM stack that loses track, asks the localizer where it is, and goes on.

It carries a camera through the simulated room, tracks corners from image to image and follows its odometry, which
drifts. Then the camera is covered and carried off: the corners are gone, it is lost. It calls `~/localize_image` with
its own image, calibration and prior, as a stack in C++ would: asynchronously, with a timeout, again with a wider
covariance where there is no answer, and with a look at status and covariance before it believes one.

    ros2 run gsfeatloc_ros localizer --ros-args -p map.path:=room.ply      # the map of the simulated room
    python examples/slam_client.py --json slam.json
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import cv2
import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from gsfeatloc_interfaces.srv import LocalizeImage
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose, matrix_from_quaternion, quaternion_from_matrix, so3_exp
from gsfeatloc_ros.simulate import Room
from gsfeatloc_ros.simulate.photos import Walk
from gsfeatloc_ros.simulate.room_camera import RoomCamera
from gsfeatloc_ros.tools.options import check_outputs, number
from gsfeatloc_ros.tools.status import run_tool

CAMERA = Camera(
    640,
    480,
    np.array([[500.0, 0.0, 322.0], [0.0, 502.0, 236.0], [0.0, 0.0, 1.0]]),
    np.array([-0.28, 0.09, 0.0008, -0.0005, 0.0]),
)
STATUSES = {getattr(LocalizeImage.Response, name): name for name in ("LOCALIZED", "REJECTED", "FAILED", "REFUSED")}


# What the stack does.


class State(Enum):
    TRACKING = "TRACKING"
    LOST = "LOST"


# Track is lost when fewer of the corners are found again in the next image.
MIN_TRACKED_RATIO = 0.3
# Standard deviations of the first prior that is sent, in metres and radians, and how many times wider they may get.
FIRST_SIGMAS = np.array([0.05] * 3 + [0.05] * 3)
MAX_WIDENING = 16.0
# An answer whose standard deviations, in metres and radians, are larger is not good enough to go on from.
MAX_SIGMA = 0.05
# Seconds until a request is given up.
TIMEOUT = 30.0


class SlamStack(Node):
    """Follows the camera from image to image while it can, and asks the localizer when it cannot.

    Args:
        T_map_camera: (4, 4) where it starts.
        service: name of the localizer's service.
        timeout: seconds until a request is given up.
    """

    def __init__(self, T_map_camera: np.ndarray, service: str, timeout: float) -> None:
        super().__init__("slam")
        self.state = State.TRACKING
        self.T_map_camera = T_map_camera
        self.log: list[dict] = []
        self._timeout = timeout
        self._client = self.create_client(LocalizeImage, service)
        self._last: np.ndarray | None = None
        # Of what is asked for while lost: the answer to come, when it is given up, how wide the prior is.
        self._future: rclpy.Future | None = None
        self._deadline = 0.0
        self._widening = 1.0

    def on_image(self, rgb: np.ndarray, stamp: Time, T_last_camera: np.ndarray) -> None:
        """Take an image (H, W, 3) and the odometry's motion (4, 4) since the last one."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        if self.state is State.TRACKING:
            self.T_map_camera = self.T_map_camera @ T_last_camera
            ratio = 1.0 if self._last is None else tracked_ratio(self._last, grey)
            if ratio < MIN_TRACKED_RATIO:
                self._enter(State.LOST, f"{ratio:.0%} of the corners found again")
        self._last = grey
        if self.state is State.LOST:
            self._ask(rgb, stamp)

    @property
    def is_served(self) -> bool:
        """Return whether there is somebody to ask."""
        return self._client.service_is_ready()

    @property
    def waits(self) -> bool:
        """Return whether an answer is still to come."""
        return self._future is not None

    def _ask(self, rgb: np.ndarray, stamp: Time) -> None:
        """Send a request, unless one is under way; give up one that takes too long."""
        if self._future is not None:
            if time.monotonic() > self._deadline:
                self._client.remove_pending_request(self._future)
                self._future = None
                self._note("no answer in time")
            return
        if not self.is_served:
            self._note(f"nobody serves {self._client.srv_name}")
            return
        request = LocalizeImage.Request(
            image=image_message(rgb, stamp), camera_info=calibration(CAMERA), has_prior=True
        )
        request.prior.header = Header(stamp=stamp, frame_id="map")
        set_pose(request.prior, self.T_map_camera)
        request.prior.pose.covariance = np.diag((self._widening * FIRST_SIGMAS) ** 2).ravel().tolist()
        self._note(f"asks with a prior of {100 * self._widening * FIRST_SIGMAS[0]:.0f} cm")
        self._future, self._deadline = self._client.call_async(request), time.monotonic() + self._timeout
        self._future.add_done_callback(self._on_answer)

    def _on_answer(self, future: rclpy.Future) -> None:
        self._future = None
        response: LocalizeImage.Response = future.result()
        status = STATUSES[response.status]
        self._note(
            f"{status} after {response.milliseconds:.0f} ms with {response.inliers} inliers: {response.reason}",
            status=status,
        )
        if response.status == LocalizeImage.Response.LOCALIZED:
            sigma = np.sqrt(np.max(np.diag(np.reshape(response.pose.pose.covariance, (6, 6)))))
            if response.pose.header.frame_id == "map" and sigma <= MAX_SIGMA:
                self.T_map_camera = pose_of(response.pose)
                self._widening = 1.0
                self._enter(State.TRACKING, f"believes it: standard deviations up to {sigma:.4f} (m, rad)")
                return
        self._widening = min(2 * self._widening, MAX_WIDENING)

    def _enter(self, state: State, why: str) -> None:
        self.state = state
        self._note(why)

    def _note(self, text: str, **values: str) -> None:
        if self.log and self.log[-1]["text"] == text:
            return
        self.log.append({"state": self.state.value, "text": text} | values)
        print(f"{self.state.value:8}  {text}", flush=True)


def tracked_ratio(last: np.ndarray, grey: np.ndarray) -> float:
    """Return the ratio of corners of a grey image (H, W) that are found in the next, and back from there."""
    corners = cv2.goodFeaturesToTrack(last, 200, 0.01, 10)
    if corners is None:
        return 0.0
    there, found, _ = cv2.calcOpticalFlowPyrLK(last, grey, corners, None)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(grey, last, there, None)
    same = np.linalg.norm(back - corners, axis=2) < 1.0
    return float(np.mean(same & (found == 1) & (found_back == 1)))


def image_message(rgb: np.ndarray, stamp: Time) -> Image:
    """Return an image message of pixels (H, W, 3) uint8 RGB."""
    height, width = rgb.shape[:2]
    header = Header(stamp=stamp, frame_id="camera_optical")
    data = array("B", rgb.tobytes())
    return Image(header=header, height=height, width=width, encoding="rgb8", step=3 * width, data=data)


def calibration(camera: Camera) -> CameraInfo:
    """Return the calibration of a camera."""
    return CameraInfo(
        width=camera.width,
        height=camera.height,
        k=camera.K.ravel().tolist(),
        d=camera.distortion.tolist(),
        distortion_model=camera.model,
    )


def set_pose(message: PoseWithCovarianceStamped, pose: np.ndarray) -> None:
    """Put a pose (4, 4) into a message."""
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z = pose[:3, 3].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion_from_matrix(pose[:3, :3]).tolist()


def pose_of(message: PoseWithCovarianceStamped) -> np.ndarray:
    """Return the pose (4, 4) of a message."""
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    rotation = matrix_from_quaternion([orientation.x, orientation.y, orientation.z, orientation.w])
    return make_pose(rotation, [position.x, position.y, position.z])


# What happens to it.

# Images before the camera is covered, and after it was found again; seconds between them, and for which it is carried.
STEPS = 8
INTERVAL = 0.05
CARRIED_SECONDS = 1.2
# Metres and radians by which the odometry errs from image to image.
DRIFT_SIGMA_METRES, DRIFT_SIGMA_RADIANS = 0.0005, 0.0005
# So many requests may go without a pose before the stack gives up.
MAX_REQUESTS = 10


@dataclass(frozen=True, eq=False)
class View:
    """What the camera sees.

    Attributes:
        phase: "walk", "covered", "carried off" or "walk on".
        T_map_camera: (4, 4) the truth, of which the stack learns nothing.
        image: (H, W, 3) uint8 RGB.
    """

    phase: str
    T_map_camera: np.ndarray
    image: np.ndarray


def journey(seed: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield phases and true poses T_map_camera (4, 4); the camera stands still while it is covered, and carried off."""
    walk = Walk(np.random.default_rng(seed).uniform(0, 2 * np.pi, 4))
    for step in range(STEPS):
        yield "walk", walk.pose(step * INTERVAL)
    lost_at = (STEPS - 1) * INTERVAL
    yield "covered", walk.pose(lost_at)
    for step in range(STEPS):
        yield "carried off" if step == 0 else "walk on", walk.pose(lost_at + CARRIED_SECONDS + step * INTERVAL)


def views(seed: int) -> Iterator[View]:
    """Yield the journey in photos; a covered camera sees noise."""
    rng, room_camera = np.random.default_rng(seed), RoomCamera(Room(seed=0), CAMERA)
    for phase, pose in journey(seed):
        if phase == "covered":
            image = rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
        else:
            image = room_camera.photo(lambda time, pose=pose: pose, 0.0, rng)
        yield View(phase, pose, image)


def odometry(last: View, view: View, rng: np.random.Generator) -> np.ndarray:
    """Return the motion (4, 4) from one view to the next as wheels measure it: they do not notice being lifted."""
    motion = np.eye(4) if view.phase == "carried off" else invert(last.T_map_camera) @ view.T_map_camera
    error = make_pose(
        so3_exp(DRIFT_SIGMA_RADIANS * rng.standard_normal(3)), DRIFT_SIGMA_METRES * rng.standard_normal(3)
    )
    return motion @ error


def travel(slam: SlamStack, executor: SingleThreadedExecutor, seed: int, timeout: float) -> list[dict]:
    """Take the stack through the journey; return what it thinks at each view, until it gives up."""
    rng, last, record = np.random.default_rng(seed), None, []

    def spin_until(condition: Callable[[], bool], seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while not condition() and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)

    spin_until(lambda: slam.is_served, timeout)
    for view in views(seed):
        motion = odometry(last or view, view, rng)
        # Lost, a robot stops: it sees the same until it has been answered.
        for _ in range(MAX_REQUESTS):
            slam.on_image(view.image, slam.get_clock().now().to_msg(), motion)
            spin_until(lambda: not slam.waits, 1.1 * timeout)
            motion = np.eye(4)
            if slam.state is State.TRACKING or view.phase == "covered":
                break
        record.append({"phase": view.phase, "state": slam.state.value, "T_map_camera": slam.T_map_camera.tolist()})
        if slam.state is State.LOST and view.phase != "covered":
            break
        last = view
        spin_until(lambda: False, INTERVAL)
    return record


def main(argv: Sequence[str] | None = None) -> int:
    """Run the stack through the journey; return 0 if it tracks at the end, 2 where something cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--service", default="/localizer/localize_image", help="to ask (%(default)s)")
    parser.add_argument(
        "--timeout", type=number(float, 0.1), default=TIMEOUT, help="seconds for an answer (%(default)g)"
    )
    parser.add_argument("--seed", type=number(int, 0), default=0, help="of the journey (%(default)s)")
    parser.add_argument("--json", type=Path, help="file of what it did")
    args = parser.parse_args(argv)
    return run_tool("slam_client", lambda: _run(args))


def _run(args: argparse.Namespace) -> int:
    check_outputs(args.json)
    rclpy.init()
    _, start = next(journey(args.seed))
    slam = SlamStack(start, args.service, args.timeout)
    executor = SingleThreadedExecutor()
    executor.add_node(slam)
    record = travel(slam, executor, args.seed, args.timeout)
    if args.json:
        args.json.write_text(json.dumps({"log": slam.log, "poses": record}, indent=1))
    slam.destroy_node()
    rclpy.shutdown()
    return 0 if slam.state is State.TRACKING else 1


if __name__ == "__main__":
    sys.exit(main())
