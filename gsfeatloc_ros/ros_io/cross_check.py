"""The node watches itself: its answers held against the odometry, and what that says in words."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from threading import Lock

import numpy as np

from gsfeatloc_ros.common.geometry import rotation_error_deg, translation_error
from gsfeatloc_ros.common.parameter import parameter
from gsfeatloc_ros.crosscheck.drive import OFFSETS, Drive, Keyframe
from gsfeatloc_ros.crosscheck.fit import Cause, Fit, explain
from gsfeatloc_ros.ros_io.decode import frame_name, nanoseconds
from gsfeatloc_ros.ros_io.inputs import Inputs
from gsfeatloc_ros.ros_io.message_types import Header

# Answers that count, the newest; and how many new ones there are between two looks at them, which take as long as half
# an answer: fewer looks where all answers that count agree.
_MAX_KEYFRAMES = 40
_BETWEEN_LOOKS, _BETWEEN_LOOKS_IN_PEACE = 5, 20
# An answer counts where the body has moved by so many metres, or turned by so many degrees, since the last that did.
_MIN_MOTION = (0.1, 5.0)
# Where an answer is off by more metres, and times the way, or by more degrees, the robot was carried, or its odometry
# began anew.
_MAX_OFF = (0.5, 5.0, 60.0)
# Answers wait for the odometry behind their stamps; no more than these.
_MAX_WAITING = 10
_MIDDLE = len(OFFSETS) // 2
# What to call a component of the lever arm (x, y, z) and of the rotation, in the axes of REP-103.
_DIRECTIONS = (("further forward", "further back"), ("further left", "further right"), ("higher", "lower"))
_AXES, _ANGLES = ("x", "y", "z"), ("roll", "pitch", "yaw")
# Standard deviations from which on a component is named.
_MIN_NAMED = 3.0


@dataclass(frozen=True)
class CrossCheckOptions:
    """When answers are held against odometry."""

    answers: int = parameter(
        20,
        "Answers, each from somewhere else, that are held against odometry (on odom, with track) to name a wrong "
        "scale, stamp or mounting of the camera; 0 for never.",
        (0, _MAX_KEYFRAMES),
    )


@dataclass(frozen=True, eq=False)
class _Answer:
    stamp: int
    T_map_camera: np.ndarray
    covariance: np.ndarray
    T_body_camera: np.ndarray


class CrossCheck:
    """Collects answers, and says what odometry says of them; `take` is for one thread, all else for any.

    Args:
        inputs: that have the odometry.
        options: when to say something.
        map_scale: as declared, units of the map frame in one unit of the file.
    """

    def __init__(self, inputs: Inputs, options: CrossCheckOptions, map_scale: float) -> None:
        self._inputs, self._options, self._map_scale = inputs, options, map_scale
        self._lock = Lock()
        self._waiting: deque[_Answer] = deque(maxlen=_MAX_WAITING)
        self._keyframes: deque[Keyframe] = deque(maxlen=_MAX_KEYFRAMES)
        self._unseen = 0
        self._body = ""
        self._fit: Fit | None = None

    @property
    def cause(self) -> Cause | None:
        """What is wrong; None where nothing is known to be."""
        return self._fit.cause if self._fit else None

    @property
    def warning(self) -> str:
        """What is wrong, and the value to set, in a sentence; empty where nothing is known to be."""
        fit = self._fit
        if fit is None or fit.cause is None:
            return ""
        if fit.cause is Cause.SCALE:
            scale, sigma = self._map_scale * (1.0 + fit.value[0]), self._map_scale * fit.sigma
            return f"odometry says map.scale {scale:.4g} +- {sigma:.2g}, not {self._map_scale:g}"
        if fit.cause is Cause.DELAY:
            late = fit.value[0] > 0
            return (
                f"odometry says that images are {fit.size:.3f} +- {fit.sigma:.3f} s {'late' if late else 'early'}: "
                f"{'take that off' if late else 'add that to'} their stamps, or let one clock stamp both"
            )
        return self._mounting_text(fit)

    def texts(self) -> dict[str, str]:
        """Return what is known by key."""
        return {
            "odometry_says": self.warning,
            "odometry_answers": str(len(self._keyframes)),
            "odometry_noise": f"{self._fit.noise:.3f}" if self._fit else "nan",
        }

    def take(self, header: Header, T_map_camera: np.ndarray, covariance: np.ndarray) -> None:
        """Take the answer (4, 4), with its covariance (6, 6), to the image of a header.

        Where odometry does not say where the robot was, or tf not where the camera is on it, the answer does not count.
        """
        stamp = nanoseconds(header.stamp)
        if not self._options.answers or not stamp or not self._inputs.has_odometry(stamp):
            return
        try:
            T_body_camera = self._inputs.camera_on_body(frame_name(header.frame_id), stamp)
        except ValueError:
            return
        with self._lock:
            if self._body != self._inputs.odometry_body:
                self._forget()
                self._body = self._inputs.odometry_body
            self._waiting.append(_Answer(stamp, T_map_camera, covariance, T_body_camera))
            self._take_waiting()
            in_peace = self.cause is None and len(self._keyframes) == _MAX_KEYFRAMES
            between_looks = _BETWEEN_LOOKS_IN_PEACE if in_peace else _BETWEEN_LOOKS
            if self._unseen < between_looks or len(self._keyframes) < max(self._options.answers, 3):
                return
            self._unseen = 0
            drive = Drive(self._keyframes)
        self._fit = explain(drive)

    def forget(self) -> None:
        """Begin anew with the next answer: the robot may have been carried. What was found stays."""
        with self._lock:
            self._forget()

    def reset(self) -> None:
        """Forget what was found as well: it was of another map."""
        self.forget()
        self._fit = None

    def _forget(self) -> None:
        self._waiting.clear()
        self._keyframes.clear()
        self._unseen = 0

    def _take_waiting(self) -> None:
        """Make keyframes of the answers behind whose stamps there is odometry now."""
        odometry = self._inputs.odometry
        while self._waiting and (odometry.newest or 0) >= self._waiting[0].stamp + 1e9 * OFFSETS[-1]:
            answer = self._waiting.popleft()
            body = odometry.pose(answer.stamp)
            if body is None or not self._has_moved(body):
                continue
            found = [odometry.pose(answer.stamp + round(1e9 * offset)) for offset in OFFSETS]
            poses = [pose for pose in found if pose is not None]
            if len(poses) == len(OFFSETS):
                keyframe = Keyframe(answer.T_map_camera, answer.covariance, answer.T_body_camera, np.array(poses))
                self._take_keyframe(keyframe)

    def _has_moved(self, T_odom_body: np.ndarray) -> bool:
        """Return whether the body, now there, has moved since the last keyframe."""
        if not self._keyframes:
            return True
        bodies = self._keyframes[-1].T_odom_body[_MIDDLE], T_odom_body
        return translation_error(*bodies) >= _MIN_MOTION[0] or rotation_error_deg(*bodies) >= _MIN_MOTION[1]

    def _take_keyframe(self, keyframe: Keyframe) -> None:
        if self._keyframes:
            last = self._keyframes[-1]
            bodies = last.T_odom_body[_MIDDLE], keyframe.T_odom_body[_MIDDLE]
            way, turn = translation_error(*bodies), rotation_error_deg(*bodies)
            answered, lever = translation_error(last.T_map_camera, keyframe.T_map_camera), last.T_body_camera[:3, 3]
            swing = np.radians(turn) * np.linalg.norm(lever)
            turned = rotation_error_deg(last.T_map_camera, keyframe.T_map_camera)
            if answered > _MAX_OFF[0] + _MAX_OFF[1] * (way + swing) or abs(turned - turn) > _MAX_OFF[2]:
                self._keyframes.clear()
        self._keyframes.append(keyframe)
        self._unseen += 1

    def _mounting_text(self, fit: Fit) -> str:
        """Return in words where else the camera is on the body."""
        named = fit.told & (np.abs(fit.value) > _MIN_NAMED * fit.sigmas)
        named[np.argmax(np.abs(fit.value))] = True
        if fit.cause is Cause.ROTATION:
            degrees, sigmas = np.degrees(fit.value), np.degrees(fit.sigmas)
            parts = [f"{_ANGLES[i]} {degrees[i]:+.1f} +- {sigmas[i]:.1f}" for i in np.flatnonzero(named)]
            text = f"is turned on {self._body} by {', '.join(parts)} degrees against what tf says"
        else:
            lever = self._keyframes[-1].T_body_camera[:3, 3] if self._keyframes else np.full(3, np.nan)
            parts = [
                f"{abs(fit.value[i]):.3f} +- {fit.sigmas[i]:.3f} m {_DIRECTIONS[i][int(fit.value[i] < 0)]} "
                f"({_AXES[i]} {lever[i] + fit.value[i]:.3f}, not {lever[i]:.3f})"
                for i in np.flatnonzero(named)
            ]
            text = f"is {', '.join(parts)} on {self._body} than tf says"
        names = _ANGLES if fit.cause is Cause.ROTATION else _AXES
        untold = [names[i] for i in np.flatnonzero(~fit.told)]
        more = f"; of {' and '.join(untold)} this drive tells nothing" if untold else ""
        return f"odometry says that the camera {text}{more}"
