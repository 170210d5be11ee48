"""Drives of a simulated robot: answers with errors of their covariance, and odometry with errors of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsfeatloc_ros.common.geometry import invert, isotropic_covariance, make_pose, so3_exp
from gsfeatloc_ros.crosscheck.drive import OFFSETS, Keyframe

# Where the camera is on the body: ahead, to the left, up; it looks ahead and a little down.
T_BODY_CAMERA = make_pose(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) @ so3_exp(np.array([-0.1, 0.0, 0.0])),
    [0.2, 0.03, 0.4],
)
# Standard deviations of answers, in metres and radians.
ANSWER = (0.003, 0.0015)


@dataclass(frozen=True)
class Wrong:
    """What is wrong with a robot: see `Cause`."""

    scale: float = 1.0
    delay: float = 0.0
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)


def planar(time: float) -> np.ndarray:
    """Pose (4, 4) of a robot on the floor that drives curves, now faster, now slower."""
    heading = 1.1 * np.sin(0.6 * time) + 0.9 * np.sin(1.3 * time + 1.0)
    position = [2.0 * np.sin(0.4 * time), 1.4 * np.sin(0.55 * time + 0.7), 0.0]
    return make_pose(so3_exp(np.array([0.0, 0.0, heading])), position)


def straight(time: float) -> np.ndarray:
    """Pose (4, 4) of a robot that drives straight on, evenly."""
    return make_pose(np.eye(3), [0.5 * time, 0.0, 0.0])


def flying(time: float) -> np.ndarray:
    """Pose (4, 4) of a robot that turns about all axes."""
    tilt = so3_exp(np.array([0.4 * np.sin(0.9 * time), 0.3 * np.sin(1.1 * time + 2.0), 0.0]))
    return planar(time) @ make_pose(tilt, [0.0, 0.0, 0.3 * np.sin(0.7 * time)])


def keyframes(
    path, count: int = 40, wrong: Wrong | None = None, noise: float = 0.02, seed: int = 0, answer: tuple = ANSWER
) -> list[Keyframe]:
    """Answers twice a second, and odometry that is off by `noise` of way and turn (standard deviation) on each leg."""
    rng, wrong = np.random.default_rng(seed), wrong or Wrong()
    covariance = isotropic_covariance(*answer)
    T_map_start = make_pose(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    T_body_camera = make_pose(
        so3_exp(np.array(wrong.rotation)) @ T_BODY_CAMERA[:3, :3], T_BODY_CAMERA[:3, 3] + wrong.lever
    )
    made, T_odom_body, before = [], np.eye(4), None
    start = rng.uniform(0.0, 100.0)
    for number in range(count):
        stamp = start + 0.5 * number
        if before is not None:
            T_odom_body = T_odom_body @ _noisy(invert(path(before)) @ path(stamp), noise, rng)
        before = stamp
        camera = path(stamp - wrong.delay) @ T_body_camera
        camera[:3, 3] *= wrong.scale
        answered = T_map_start @ camera
        answered[:3, 3] += answer[0] * rng.normal(size=3)
        answered[:3, :3] = so3_exp(answer[1] * rng.normal(size=3)) @ answered[:3, :3]
        window = np.array([T_odom_body @ invert(path(stamp)) @ path(stamp + offset) for offset in OFFSETS])
        made.append(Keyframe(answered, covariance, T_BODY_CAMERA, window))
    return made


def _noisy(motion: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    way, angle = np.linalg.norm(motion[:3, 3]), np.arccos(np.clip(0.5 * (np.trace(motion[:3, :3]) - 1.0), -1.0, 1.0))
    turned = motion[:3, :3] @ so3_exp(noise * angle * rng.normal(size=3))
    return make_pose(turned, motion[:3, 3] + noise * way * rng.normal(size=3))
