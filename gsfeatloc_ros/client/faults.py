"""What a localizer has to bear while it works: bad parameters, malformed messages, bombs, planted files."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Callable
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, Image

from gsfeatloc_ros.client.client_node import ClientNode
from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image
from gsfeatloc_ros.client.robot import camera_of
from gsfeatloc_ros.node.qos import NEWEST
from gsfeatloc_ros.render.cache import SUFFIX

try:
    from gsfeatloc_interfaces.srv import LocalizeImage
except ImportError:
    LocalizeImage = None

# Seconds between two faults, and those that an answer may take.
_PERIOD, _MAX_WAIT = 2.0, 10.0
# A kind that rcl_interfaces does not know, and the one of strings.
_NO_TYPE, _STRING = 99, 4


def run_faults(map_file: Path, size: tuple[int, int], sent: Synchronized, unanswered: Synchronized) -> None:
    """Make one fault after another until this process is ended; for a process of its own.

    Args:
        map_file: that the localizer serves; files are planted beside it.
        size: width and height of the robot's images.
        sent: is counted up with each fault.
        unanswered: is counted up with each request that got no answer in time.
    """
    faults = _Faults(map_file, size)
    for number in range(1 << 30):
        answered = faults.make(number)
        sent.value += 1
        unanswered.value += not answered
        time.sleep(_PERIOD)


class _Faults:
    def __init__(self, map_file: Path, size: tuple[int, int]) -> None:
        self._size, self._client = size, ClientNode("faults")
        self._maps = _planted(map_file)
        node = self._client.node
        self._image = node.create_publisher(Image, "image", NEWEST)
        self._camera_info = node.create_publisher(CameraInfo, "camera_info", NEWEST)
        self._prior = node.create_publisher(PoseStamped, "prior", 5)
        self._parameters = node.create_client(SetParameters, "localizer/set_parameters")
        self._kinds: list[Callable[[], bool]] = [
            self._parameter_of_no_type,
            self._image_cut_short,
            self._camera_info_of_nan,
            self._prior_of_nan,
            self._bytes_that_are_no_message,
            self._map,
        ]
        if LocalizeImage is not None:
            self._localize_image = node.create_client(LocalizeImage, "localizer/localize_image")
            self._kinds.append(self._image_of_a_lying_size)

    def make(self, number: int) -> bool:
        """Make one of the faults, in turn; return whether what has to be answered was."""
        return self._kinds[number % len(self._kinds)]()

    def _parameter_of_no_type(self) -> bool:
        return self._set(Parameter(name="mode", value=ParameterValue(type=_NO_TYPE)))

    def _map(self) -> bool:
        """Bombs, pipes, and the right map with a planted cache, which is to be found out."""
        self._maps.append(path := self._maps.pop(0))
        value = ParameterValue(type=_STRING, string_value=str(path))
        return self._set(Parameter(name="map.path", value=value))

    def _image_cut_short(self) -> bool:
        image = rgb_image(np.zeros((48, 64, 3), np.uint8))
        image.data = image.data[:100]
        return self._publish(self._image, image)

    def _camera_info_of_nan(self) -> bool:
        info = camera_info_of(camera_of(self._size))
        info.k[0] = math.nan
        return self._publish(self._camera_info, info)

    def _prior_of_nan(self) -> bool:
        prior = pose_stamped(np.eye(4))
        prior.pose.position.x = math.nan
        return self._publish(self._prior, prior)

    def _bytes_that_are_no_message(self) -> bool:
        return self._publish(self._image, serialize_message(Image())[:9] + b"\xff" * 20)

    def _image_of_a_lying_size(self) -> bool:
        request = LocalizeImage.Request(camera_info=camera_info_of(camera_of(self._size)))
        request.image = Image(encoding="rgb8", width=2**32 - 1, height=2**32 - 1, step=2**32 - 1, data=bytes(100))
        return self._ask(self._localize_image, request)

    def _set(self, parameter: Parameter) -> bool:
        return self._ask(self._parameters, SetParameters.Request(parameters=[parameter]))

    def _ask(self, service: Any, request: Any) -> bool:
        return self._client.spin_until(service.service_is_ready, _MAX_WAIT) and self._client.spin_until(
            service.call_async(request).done, _MAX_WAIT
        )

    def _publish(self, publisher: Any, message: Any) -> bool:
        publisher.publish(message)
        return True


def _planted(map_file: Path) -> list[Path]:
    """Make files that harm who believes them, beside the map; return those that are to be taken for maps."""
    folder = map_file.parent / "faults"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    pipe, bomb, foreign, piped = (folder / f"{name}.ply" for name in ("pipe", "bomb", "foreign", "piped"))
    os.mkfifo(pipe)
    header = map_file.read_bytes().split(b"end_header\n")[0]
    lines = [b"element vertex 49000000" if line.startswith(b"element vertex") else line for line in header.split(b"\n")]
    bomb.write_bytes(b"\n".join(lines) + b"end_header\n")
    for path in (foreign, piped):
        shutil.copy(map_file, path)
    planted = foreign.with_name(foreign.name + SUFFIX)
    planted.write_bytes(os.urandom(100_000))
    planted.chmod(0o666)
    os.mkfifo(piped.with_name(piped.name + SUFFIX))
    return [pipe, bomb, foreign, piped]
