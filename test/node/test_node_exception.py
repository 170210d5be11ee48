"""An exception that nobody foresaw, in a node of this process: no other localizer may run beside it."""

from __future__ import annotations

import threading
from dataclasses import replace

import rclpy
from node_harness import assert_close, connected_client, node_arguments
from rclpy.lifecycle import TransitionCallbackReturn

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image
from gsfeatloc_ros.node.localizer_node import LocalizerNode


class OutOfMemoryOnce:
    """A renderer whose first picture goes wrong in a way that nobody foresaw."""

    def __init__(self, renderer) -> None:
        self._renderer = renderer
        self.device = renderer.device
        self._calls = 0

    def render(self, *arguments):
        self._calls += 1
        if self._calls == 1:
            raise MemoryError("Unable to allocate 3 TiB")
        return self._renderer.render(*arguments)


def test_unforeseen_exception_is_reported_and_survived(room_map_file, room_camera, room_photos):
    photo = room_photos[0]
    rclpy.init(args=node_arguments(map__path=room_map_file, matcher__name="sift"))
    node = LocalizerNode()
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    engine = node.session.engine
    node.session.use_map(replace(engine, renderer=OutOfMemoryOnce(engine.renderer)))
    node.trigger_activate()
    spinning = threading.Thread(target=rclpy.spin, args=(node,))
    spinning.start()
    try:
        with connected_client() as client:
            client.send_camera_info(camera_info_of(room_camera))
            client.send_prior(pose_stamped(photo.T_map_camera_prior))
            image = rgb_image(photo.image)
            diagnostic = client.attempt(image)
            assert diagnostic.values["status"] == "error"
            assert diagnostic.reason == "MemoryError: Unable to allocate 3 TiB"
            assert client.pose_of(image) is None
            image = rgb_image(photo.image)
            assert client.attempt(image).ok
            assert_close(client.pose_of(image), photo.T_map_camera)
    finally:
        assert node.session.stop(10.0)
        rclpy.shutdown()
        spinning.join(10.0)
        node.destroy_node()
