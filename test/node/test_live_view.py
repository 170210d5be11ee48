"""What gsfeatloc view shows of a running node, and the priors that it sends."""

from __future__ import annotations

import time

import numpy as np
import pytest

from gsfeatloc_ros.client.client_node import ClientNode
from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, pose_with_covariance, rgb_image
from gsfeatloc_ros.common.geometry import invert, isotropic_covariance, make_pose
from gsfeatloc_ros.view.prior_panel import base_facing
from gsfeatloc_ros.view.store import Store

POSE = make_pose(np.eye(3), [1.0, 2.0, 3.0])
STAMP = 5_000_000_007


def wait_for(condition):
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture
def live():
    """A listener to /robot/localizer and its store."""
    from gsfeatloc_ros.client.live import LiveNode

    store = Store()
    node = LiveNode("/robot/localizer", "map", store, ["--ros-args", "-r", "pose:=answers"])
    yield node, store
    node.close()


@pytest.fixture
def robot():
    """What a localizer called /robot/localizer says, and the robot."""
    node = ClientNode("localizer", "/robot")
    node.node.declare_parameter("prior_frame", "camera")
    yield node
    node.close()


def publisher(robot, kind, topic):
    from gsfeatloc_ros.node.qos import LATCHED

    made = robot.node.create_publisher(kind, topic, LATCHED)
    wait_for(made.get_subscription_count)
    return made


def test_an_attempt_is_put_together_of_all_that_a_node_says_of_it(live, robot):
    from builtin_interfaces.msg import Time
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped
    from sensor_msgs.msg import Image

    _, store = live
    stamp = Time(sec=5, nanosec=7)
    publisher(robot, PoseStamped, "/robot/prior").publish(pose_stamped(POSE))
    assert robot.spin_until(lambda: store.newest_prior is not None, 30)
    answer, elsewhere = pose_with_covariance(POSE, np.eye(6)), pose_with_covariance(POSE, frame_id="odom")
    answer.header.stamp = stamp
    poses = publisher(robot, PoseWithCovarianceStamped, "/robot/answers")
    poses.publish(elsewhere)
    poses.publish(answer)
    several = PoseArray(header=answer.header, poses=[answer.pose.pose] * 2)
    publisher(robot, PoseArray, "/robot/localizer/candidates").publish(several)
    several.poses.append(answer.pose.pose)
    publisher(robot, PoseArray, "/robot/localizer/searched").publish(several)
    picture = rgb_image(np.full((4, 6, 3), 90, np.uint8))
    picture.header.stamp = stamp
    publisher(robot, Image, "/robot/debug_image").publish(picture)
    values = [KeyValue(key="status", value="ambiguous"), KeyValue(key="stamp", value="5.000000007")]
    said = DiagnosticStatus(name="robot/localizer: localization", message="two places", values=values)
    other = DiagnosticStatus(name="other/localizer: localization", message="no", values=values)
    publisher(robot, DiagnosticArray, "/diagnostics").publish(DiagnosticArray(status=[other, said]))
    wait_for(lambda: store.attempts() and store.attempts()[0].status)
    wait_for(lambda: store.attempts()[0].candidates is not None and store.attempts()[0].searched is not None)
    wait_for(lambda: store.picture(STAMP) is not None)
    (attempt,) = store.attempts()
    assert (attempt.stamp, attempt.status, attempt.reason) == (STAMP, "ambiguous", "two places")
    np.testing.assert_allclose(attempt.pose, POSE)
    np.testing.assert_allclose(attempt.covariance, np.eye(6))
    assert attempt.candidates.shape == (2, 4, 4)
    assert attempt.searched.shape == (3, 4, 4)
    np.testing.assert_allclose(store.prior(STAMP).pose, POSE)
    assert not store.prior(STAMP).of_base


@pytest.mark.parametrize("prior_frame", ["camera", "base"])
def test_a_prior_is_drawn_of_what_the_node_takes_it_for(live, robot, prior_frame):
    from geometry_msgs.msg import Pose, PoseStamped, Quaternion
    from rclpy.parameter import Parameter
    from std_msgs.msg import Header

    _, store = live
    robot.node.set_parameters([Parameter("prior_frame", value=prior_frame)])
    # It may come before the node has said so; a pose that is none, too.
    priors = publisher(robot, PoseStamped, "/robot/prior")
    priors.publish(PoseStamped(header=Header(frame_id="map"), pose=Pose(orientation=Quaternion(w=0.0))))
    robot.spin(3.0)
    priors.publish(pose_stamped(POSE))
    assert robot.spin_until(lambda: store.newest_prior is not None, 30)
    np.testing.assert_allclose(store.newest_prior.pose, POSE)
    assert store.newest_prior.of_base == (prior_frame == "base")


def test_a_prior_of_odometry_is_of_the_frame_that_it_names(live, robot):
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import CameraInfo
    from std_msgs.msg import Header

    _, store = live
    priors = publisher(robot, Odometry, "/robot/prior_odometry")
    prior = Odometry(header=Header(frame_id="map"), child_frame_id="optical")
    prior.pose.pose = pose_stamped(POSE).pose
    priors.publish(prior)
    time.sleep(0.5)
    # Nobody knows yet what the camera's frame is.
    assert store.newest_prior is None
    publisher(robot, CameraInfo, "/robot/camera_info").publish(CameraInfo(header=Header(frame_id="optical")))
    wait_for(lambda: store.newest_prior is not None)
    assert not store.newest_prior.of_base
    prior.child_frame_id = "body"
    priors.publish(prior)
    wait_for(lambda: store.newest_prior.of_base)
    np.testing.assert_allclose(store.newest_prior.pose, POSE)


def test_priors_are_sent_as_rviz_does_and_of_the_camera(live, robot):
    from geometry_msgs.msg import PoseWithCovarianceStamped

    node, store = live
    assert "nobody listens" in node.send_base(POSE, np.eye(6))
    # What is sent is shown as what comes from others is.
    wait_for(lambda: store.newest_prior is not None)
    assert store.newest_prior.of_base
    np.testing.assert_allclose(store.newest_prior.pose, POSE)
    got = []
    for topic in ("initialpose", "prior_with_covariance"):
        robot.node.create_subscription(PoseWithCovarianceStamped, f"/robot/{topic}", got.append, 10)
    wait_for(
        lambda: "nobody" not in node.send_base(POSE, np.eye(6)) and "nobody" not in node.send_camera(POSE, np.eye(6))
    )
    assert robot.spin_until(lambda: len(got) >= 2, 30)
    assert got[0].header.frame_id == "map"
    assert got[0].pose.pose.position.y == 2.0
    assert got[0].pose.covariance[0] == 1.0
    # On two topics, what was sent first may be heard last.
    assert robot.spin_until(lambda: node.send_camera(POSE, np.eye(6)) and not store.newest_prior.of_base, 30)


def test_a_running_localizer_takes_the_prior_of_two_clicks_and_is_seen(tf, room_map_file, room_camera, photo):
    """The base stands on the floor under the camera; its camera looks up or down, as the photo's does."""
    from node_harness import connected_client, running_localizer
    from tf2_msgs.msg import TFMessage
    from transforms import transform_stamped

    from gsfeatloc_ros.client.live import LiveNode
    from gsfeatloc_ros.node.qos import LATCHED

    T_map_camera, store = photo.T_map_camera, Store()
    place = T_map_camera[:3, 3] * [1, 1, 0]
    T_map_base = base_facing(place, place + T_map_camera[:3, 2])
    with running_localizer(map__path=room_map_file) as process, connected_client() as client:
        static = client.node.create_publisher(TFMessage, "/tf_static", LATCHED)
        T_base_camera = invert(T_map_base) @ T_map_camera
        mount = transform_stamped("base_link", "camera_optical", T_base_camera, client.next_stamp())
        static.publish(TFMessage(transforms=[mount]))
        client.send_camera_info(camera_info_of(room_camera))
        live = LiveNode("localizer", "map", store)
        try:
            clicked = base_facing(place + np.array([0.2, -0.1, 0.0]), place + 3 * T_map_camera[:3, 2])
            wait_for(lambda: "nobody" not in live.send_base(clicked, isotropic_covariance(0.3, 0.3)))
            client.spin(0.5)
            image = rgb_image(photo.image)
            # Of the clock that stamps what is clicked.
            image.header.stamp = client.node.get_clock().now().to_msg()
            answer = client.attempt_as_stamped(image)
            assert answer.ok, f"{answer.reason}\n{process.output}"
            assert answer.values["prior"] == "initialpose"
            stamp = 10**9 * image.header.stamp.sec + image.header.stamp.nanosec
            wait_for(lambda: store.attempts() and store.attempts()[-1].covariance is not None)
            wait_for(lambda: store.attempts()[-1].status and store.attempts()[-1].searched is not None)
            wait_for(lambda: store.picture(stamp) is not None)
        finally:
            live.close()
    seen = store.attempts()[-1]
    assert (seen.stamp, seen.status) == (stamp, "localized")
    np.testing.assert_allclose(seen.pose, T_map_camera, atol=0.02)
    np.testing.assert_allclose(seen.searched[0], clicked @ T_base_camera, atol=1e-6)
