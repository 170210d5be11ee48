"""A camera in a process of its own: publishes the picture of a .npy file ten times a second until it is killed."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rclpy
from sensor_msgs.msg import Image

from gsfeatloc_ros.client.messages import rgb_image


@contextmanager
def running_camera(picture: Path) -> Iterator[subprocess.Popen]:
    """A camera that sends a picture, until it is left."""
    process = subprocess.Popen([sys.executable, __file__, picture])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def main() -> None:
    """Publish; the picture's file is the one argument."""
    message = rgb_image(np.load(sys.argv[1]))
    rclpy.init()
    node = rclpy.create_node("camera")
    publisher = node.create_publisher(Image, "image", 5)
    while True:
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)
        time.sleep(0.1)


if __name__ == "__main__":
    main()
