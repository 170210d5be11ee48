"""An exception that nobody foresaw, in a node of this process: no other localizer may run beside it."""

from __future__ import annotations

import threading
from dataclasses import replace

import pytest
import rclpy
from gsfeatloc_interfaces.srv import LocalizeImage
from node_harness import assert_close, connected_client, node_arguments
from rclpy.lifecycle import TransitionCallbackReturn

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image
from gsfeatloc_ros.node.executor import GuardedExecutor
from gsfeatloc_ros.node.localizer_node import LocalizerNode


class OutOfMemory:
    """A renderer whose next picture goes wrong in a way that nobody foresaw, as often as it is set off."""

    def __init__(self, renderer) -> None:
        self._renderer = renderer
        self.device, self.reading = renderer.device, renderer.reading
        self.set_off = False

    def render(self, *arguments):
        if self.set_off:
            self.set_off = False
            raise MemoryError("Unable to allocate 3 TiB")
        return self._renderer.render(*arguments)


@pytest.fixture(scope="module")
def node(room_map_file):
    rclpy.init(args=node_arguments(map__path=room_map_file, matcher__name="sift"))
    node = LocalizerNode()
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    engine = node.session.engine
    node.session.use_map(replace(engine, renderer=OutOfMemory(engine.renderer)), node.session.settings.map)
    node.trigger_activate()
    spinning = threading.Thread(target=rclpy.spin, args=(node, GuardedExecutor(node.report_failure)))
    spinning.start()
    try:
        yield node
    finally:
        assert node.session.stop(10.0)
        rclpy.shutdown()
        spinning.join(10.0)
        node.destroy_node()


@pytest.fixture
def client(node, room_camera, photo):
    with connected_client() as client:
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(pose_stamped(photo.T_map_camera_prior))
        yield client


def test_unforeseen_exception_is_reported_and_survived(node, client, photo):
    node.session.engine.renderer.set_off = True
    image = rgb_image(photo.image)
    diagnostic = client.attempt(image)
    assert diagnostic.values["status"] == "error"
    assert diagnostic.reason == "MemoryError: Unable to allocate 3 TiB"
    assert client.pose_of(image) is None
    image = rgb_image(photo.image)
    assert client.attempt(image).ok
    assert_close(client.pose_of(image), photo.T_map_camera)


def test_unforeseen_exception_on_a_request_is_an_error_not_a_refusal(node, client, room_camera, photo):
    request = LocalizeImage.Request(image=rgb_image(photo.image), camera_info=camera_info_of(room_camera))
    node.session.engine.renderer.set_off = True
    response = client.call(LocalizeImage, "localizer/localize_image", request)
    assert response.status == LocalizeImage.Response.ERROR
    assert response.reason == "MemoryError: Unable to allocate 3 TiB"
    assert response.inliers == 0
    response = client.call(LocalizeImage, "localizer/localize_image", request)
    assert response.status == LocalizeImage.Response.LOCALIZED


def test_unforeseen_exception_on_the_newest_image_is_a_failure(node, client, photo):
    assert client.attempt(rgb_image(photo.image)).ok
    node.session.engine.renderer.set_off = True
    answer = client.relocalize()
    assert (answer.success, answer.message) == (False, "MemoryError: Unable to allocate 3 TiB")
    assert client.relocalize().success


def test_a_parameter_without_effect_can_be_set_while_it_runs(node, client):
    before = node.session.engine.options
    assert client.set_parameter("localizer.min_agreement", 0.4).successful
    assert client.set_parameter("localizer.min_inlier_ratio", "much").successful
    assert node.session.engine.options == before
    assert not client.set_parameter("localizer.max_risk", 2.0).successful
    assert client.set_parameter("localizer.max_risk", 1e-3).successful
    assert node.session.engine.options.limits.max_risk == 1e-3
    assert client.set_parameter("localizer.max_risk", 1e-4).successful
