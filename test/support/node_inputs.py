"""Strange inputs for a running localizer, drawn by chance: messages, requests, parameters, transitions."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_targets import mutated
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from gsfeatloc_interfaces.srv import LocalizeImage
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
from node_harness import Client
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Empty, Trigger

from gsfeatloc_ros.ros_io.settings import PARAMETERS

# Transitions that end a lifecycle node, by the state in which they do.
SHUTDOWNS = (5, 6, 7)

_TOPICS: dict[str, Callable[[], Any]] = {
    "image": lambda: Image(encoding="rgb8", width=64, height=48, step=192, data=bytes(192 * 48)),
    "camera_info": lambda: CameraInfo(width=64, height=48, k=[50.0, 0, 32, 0, 50, 24, 0, 0, 1], d=[0.0] * 5),
    "prior": PoseStamped,
    "prior_with_covariance": PoseWithCovarianceStamped,
    "initialpose": PoseWithCovarianceStamped,
    "odom": Odometry,
}
_NUMBERS = (0.0, -0.0, 1.0, -1.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e-9)
_INTEGERS = (0, 1, -1, 2, 7, 255, 2**16, 2**31 - 1, -(2**31), 2**32 - 1, 2**63 - 1, -(2**63), 2**64 - 1)
_WORDS = (
    "",
    "map",
    "/",
    "/dev/null",
    "../..",
    "~",
    "%s%n",
    "nan",
    "a" * 10_000,
    "\u00e9\u4e2d\U0001f600",
    "rgb8",
    "\n\x1b[2J",
)
_ODD_NAMES = ("", ".", "use_sim_time", "map", "map.path.path", "qos_overrides./image.subscription.depth", "a" * 5000)
_TYPES_OF_VALUES = (*range(12), 99, 255)


@dataclass(frozen=True)
class Input:
    """Something to be sent.

    Attributes:
        kind: of it, for the counts.
        what: that tells it from others of its kind: a topic, a service, the number of a transition.
        send: sends it, and waits at most so many seconds for an answer where there is to be one; raises AssertionError.
    """

    kind: str
    what: str | int
    send: Callable[[Client, float], None]


def draw_input(rng: np.random.Generator, pipe: Path) -> Input:
    """Return an input; `pipe` is the path of a pipe, as a map."""
    kinds = (_bytes, _message, _service, _query, partial(_parameters, pipe=pipe), _transition)
    return kinds[rng.choice(len(kinds), p=(0.25, 0.25, 0.2, 0.05, 0.24, 0.01))](rng)


def _bytes(rng: np.random.Generator) -> Input:
    topic = _pick(rng, tuple(_TOPICS))
    message = _TOPICS[topic]()
    return _publication("bytes", topic, type(message), mutated(rng, serialize_message(message)))


def _message(rng: np.random.Generator) -> Input:
    topic = _pick(rng, tuple(_TOPICS))
    message = _TOPICS[topic]()
    make_strange(message, rng)
    return _publication("message", topic, type(message), message)


def _publication(kind: str, topic: str, message_type: type, content: object) -> Input:
    def send(client: Client, timeout: float) -> None:
        client.publisher(topic, message_type).publish(content)

    return Input(kind, topic, send)


def _service(rng: np.random.Generator) -> Input:
    request = LocalizeImage.Request(image=_TOPICS["image"](), camera_info=_TOPICS["camera_info"]())
    make_strange(request, rng)
    services = (
        ("localizer/relocalize", Trigger, Trigger.Request()),
        ("reinitialize_global_localization", Empty, Empty.Request()),
        ("localizer/localize_image", LocalizeImage, request),
    )
    return _call("request", *services[rng.choice(3, p=(0.2, 0.1, 0.7))])


def _query(rng: np.random.Generator) -> Input:
    service = _pick(rng, (GetParameters, GetParameterTypes, DescribeParameters, ListParameters))
    names = [_name(rng) for _ in range(rng.integers(4))]
    request = service.Request(prefixes=names) if service is ListParameters else service.Request(names=names)
    return _call("parameters asked for", f"localizer/{_snake(service.__name__)}", service, request)


def _parameters(rng: np.random.Generator, pipe: Path) -> Input:
    service = _pick(rng, (SetParameters, SetParametersAtomically))
    given = [Parameter(name=_name(rng)) for _ in range(rng.integers(1, 4))]
    for parameter in given:
        make_strange(parameter.value, rng, 1.0)
        parameter.value.type = int(_pick(rng, _TYPES_OF_VALUES))
        if parameter.name == "map.path":
            parameter.value.string_value = str(pipe)
    return _call("parameters set", f"localizer/{_snake(service.__name__)}", service, service.Request(parameters=given))


def _transition(rng: np.random.Generator) -> Input:
    request = ChangeState.Request()
    request.transition.id = int(rng.integers(0, 100)) if rng.random() < 0.5 else int(rng.integers(0, 9))
    request.transition.label = str(_pick(rng, ("", "configure", "shutdown", *_WORDS)))
    call = _call("transition", "localizer/change_state", ChangeState, request)
    return Input(call.kind, request.transition.id, call.send)


def _call(kind: str, name: str, service: type, request: object) -> Input:
    return Input(kind, name, lambda client, timeout: client.call(service, name, request, timeout) and None)


def make_strange(message: Any, rng: np.random.Generator, share: float = 0.2) -> None:
    """Give a share of all fields of a message, those of the messages in it too, values that nobody sends."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        if hasattr(value, "get_fields_and_field_types"):
            make_strange(value, rng, share)
        elif rng.random() < share:
            try:
                setattr(message, name, _strange(rng, kind))
            # It does not fit the field: rclpy would not send it.
            except (AssertionError, TypeError, OverflowError):
                continue


def _strange(rng: np.random.Generator, kind: str) -> object:
    """Return a value of a type as rclpy names it."""
    array = re.fullmatch(r"sequence<(.+?)(?:, \d+)?>|(.+)\[(\d+)\]", kind)
    if array:
        count = int(array[3]) if array[3] else int(_pick(rng, (0, 1, 3, 1000)))
        return [_strange(rng, array[1] or array[2]) for _ in range(count)]
    if kind == "boolean":
        return bool(rng.integers(2))
    if kind in ("float", "double"):
        return float(_pick(rng, _NUMBERS))
    if "int" in kind or kind == "octet":
        bits = int(re.search(r"\d+", kind)[0]) if kind != "octet" else 8
        value = int(_INTEGERS[rng.integers(len(_INTEGERS))]) % 2**bits
        signed = not kind.startswith("u") and kind != "octet"
        value = value - 2**bits if signed and value >= 2 ** (bits - 1) else value
        return bytes([value]) if kind == "octet" else value
    return str(_pick(rng, _WORDS))


def _name(rng: np.random.Generator) -> str:
    names = [parameter.name for parameter in PARAMETERS]
    return str(_pick(rng, names if rng.random() < 0.8 else _ODD_NAMES))


def _snake(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


def _pick(rng: np.random.Generator, values: Any) -> Any:
    return values[rng.integers(len(values))]
