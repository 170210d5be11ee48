"""The installed localizer on a robot with tf: priors and answers of its base, the transform from the map to odom."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from gsfeatloc_interfaces.msg import ProtectionLevel
from node_harness import assert_close, assert_start_fails, connected_client, running_localizer
from std_srvs.srv import Empty
from transforms import transform_stamped

from gsfeatloc_ros.client.messages import (
    camera_info_of,
    pose_matrix,
    pose_stamped,
    pose_with_covariance,
    rgb_image,
    stamp_of,
)
from gsfeatloc_ros.common.geometry import invert, make_pose, matrix_from_quaternion, so3_exp
from gsfeatloc_ros.localize.protection import protection_level

# Last: a tf2_ros that is installed comes before it.
sys.path.append(str(Path(__file__).parents[1] / "support" / "tf2_stand_in"))
import tf2_ros
from tf2_msgs.msg import TFMessage

STAND_IN = sys.path[-1]
HAS_TF2 = not tf2_ros.__file__.startswith(STAND_IN)
T_ODOM_BASE = make_pose(so3_exp(np.array([0.0, 0.0, 1.2])), [3.0, -1.0, 0.0])
ALIGNED = {"map__aligned": True, "publish_tf": True, "pose_frame": "base", "prior_frame": "base"}


@pytest.fixture
def T_map_base(photo):
    """The base on the floor under the camera, turned as the camera is."""
    ahead = photo.T_map_camera[:3, 2]
    yaw = np.arctan2(ahead[1], ahead[0])
    return make_pose(so3_exp(np.array([0.0, 0.0, yaw])), [*photo.T_map_camera[:2, 3], 0.0])


def tell_where_the_camera_is(client, T_base_camera: np.ndarray) -> tf2_ros.StaticTransformBroadcaster:
    broadcaster = tf2_ros.StaticTransformBroadcaster(client.node)
    broadcaster.sendTransform(transform_stamped("base_link", "camera_optical", T_base_camera, client.next_stamp()))
    return broadcaster


def of_odom(heard: list[TFMessage]) -> list[TransformStamped]:
    """Return the transforms from the map to odom that were heard."""
    return [t for message in heard for t in message.transforms if t.child_frame_id == "odom"]


def told(heard: list[TFMessage]) -> list[np.ndarray]:
    """Return them as poses (4, 4)."""
    poses = []
    for t in of_odom(heard):
        p, q = t.transform.translation, t.transform.rotation
        poses.append(make_pose(matrix_from_quaternion([q.x, q.y, q.z, q.w]), [p.x, p.y, p.z]))
    return poses


def test_priors_and_answers_of_the_base_and_tf_from_the_map_to_odom(tf, room_map_file, room_camera, photo, T_map_base):
    off = invert(photo.T_map_camera) @ photo.T_map_camera_prior
    T_base_camera = invert(T_map_base) @ photo.T_map_camera
    T_map_odom = T_map_base @ invert(T_ODOM_BASE)
    with running_localizer(map__path=room_map_file, **ALIGNED) as process, connected_client() as client:
        static = tell_where_the_camera_is(client, T_base_camera)
        moving, heard = tf2_ros.TransformBroadcaster(client.node), client.listen(TFMessage, "/tf")
        levels = client.listen(ProtectionLevel, "protection_level")
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(pose_stamped(T_map_base @ T_base_camera @ off @ invert(T_base_camera)))
        image = rgb_image(photo.image)
        image.header.stamp = client.next_stamp()
        moving.sendTransform(transform_stamped("odom", "base_link", T_ODOM_BASE, image.header.stamp))
        client.spin(0.5)
        client.send_image(image)
        assert client.spin_until(lambda: stamp_of(image) in client.poses), process.output
        pose = client.poses[stamp_of(image)]
        assert pose.header.frame_id == "map"
        assert_close(pose, T_map_base)
        covariance = np.reshape(pose.pose.covariance, (6, 6))
        assert (np.linalg.eigvalsh(covariance) > 0).all()
        # Of the base too: the camera's errors of rotation move it.
        assert client.spin_until(lambda: any(stamp_of(level) == stamp_of(image) for level in levels))
        assert levels[-1].radius == pytest.approx(protection_level(covariance).radius)

        # It is told again and again, with stamps that go on, so that it can be used between answers.
        assert client.spin_until(lambda: len(of_odom(heard)) > 5)
        assert of_odom(heard)[-1].header.frame_id == "map"
        stamps = [t.header.stamp.sec + 1e-9 * t.header.stamp.nanosec for t in of_odom(heard)]
        assert stamps == sorted(stamps)
        assert stamps[-1] > stamps[0]
        found = told(heard)[-1]
        # The base is where the pose says.
        np.testing.assert_allclose(found @ T_ODOM_BASE, pose_matrix(pose), atol=1e-9)
        np.testing.assert_allclose(found, T_map_odom, atol=0.1)
        client.node.destroy_publisher(static)  # kept until here: static transforms come from who told them


def test_a_flat_transform_that_ends_when_the_robot_is_lost(tf, room_map_file, room_camera, photo, T_map_base):
    """The base is told to be higher and tilted: the transform is flat all the same, and right where the robot is."""
    tilted = T_map_base @ make_pose(so3_exp(np.array([0.02, 0.01, 0.0])), [0.0, 0.0, 0.05])
    T_base_camera = invert(tilted) @ photo.T_map_camera
    parameters = {"map__path": room_map_file, "planar_tf": True} | ALIGNED | {"prior_frame": "camera"}
    with running_localizer(**parameters) as process, connected_client() as client:
        static = tell_where_the_camera_is(client, T_base_camera)
        moving, heard = tf2_ros.TransformBroadcaster(client.node), client.listen(TFMessage, "/tf")
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(pose_stamped(photo.T_map_camera_prior))
        image = rgb_image(photo.image)
        image.header.stamp = client.next_stamp()
        moving.sendTransform(transform_stamped("odom", "base_link", T_ODOM_BASE, image.header.stamp))
        client.spin(0.5)
        client.send_image(image)
        assert client.spin_until(lambda: len(told(heard)) > 5), process.output
        flat = told(heard)[-1]
        np.testing.assert_allclose(flat[2], [0, 0, 1, 0], atol=1e-9)
        np.testing.assert_allclose((flat @ T_ODOM_BASE)[:2, 3], T_map_base[:2, 3], atol=0.02)
        client.call(Empty, "reinitialize_global_localization", Empty.Request())
        client.spin(0.5)
        count = len(told(heard))
        client.spin(1.0)
        assert len(told(heard)) == count
        process.wait_for_output("lost: asked for by reinitialize_global_localization", 5.0)
        client.node.destroy_publisher(static)


def test_of_a_planar_robot_only_x_y_and_yaw_are_unknown(tf, room_map_file, room_camera, photo, T_map_base):
    parameters = {"map__path": room_map_file, "index__build": True, "map__aligned": True, "search__planar": True}
    with running_localizer(**parameters) as process, connected_client() as client:
        process.wait_for_index()
        static = tell_where_the_camera_is(client, invert(T_map_base) @ photo.T_map_camera)
        client.send_camera_info(camera_info_of(room_camera))
        image = rgb_image(photo.image)
        answer = client.attempt(image)
        assert answer.ok, f"{answer.reason}\n{process.output}"
        assert answer.values["prior"] == "plane"
        assert_close(client.pose_of(image), photo.T_map_camera)
        client.node.destroy_publisher(static)


def test_a_map_that_nobody_aligned_has_no_floor(room_map_file):
    assert_start_fails("search.planar needs map.aligned", map__path=room_map_file, search__planar=True)
    assert_start_fails("index.camera_height needs map.aligned", map__path=room_map_file, index__camera_height=0.4)


def test_initialpose_as_rviz_sends_it(tf, room_map_file, room_camera, photo, T_map_base):
    """On the floor, a little off, with RViz's covariance: z, roll and pitch exactly known."""
    with running_localizer(map__path=room_map_file) as process, connected_client() as client:
        static = tell_where_the_camera_is(client, invert(T_map_base) @ photo.T_map_camera)
        client.send_camera_info(camera_info_of(room_camera))
        off = make_pose(so3_exp(np.array([0.0, 0.0, 0.3])), [0.2, -0.3, 0.0])
        message = pose_with_covariance(T_map_base @ off)
        message.pose.covariance[0] = message.pose.covariance[7] = 0.25
        message.pose.covariance[35] = 0.06853891909122467
        client.publish("initialpose", message)
        image = rgb_image(photo.image)
        answer = client.attempt(image)
        assert answer.ok, f"{answer.reason}\n{process.output}"
        assert_close(client.pose_of(image), photo.T_map_camera)
        client.node.destroy_publisher(static)


def test_a_prior_in_the_frame_of_odom(tf, room_map_file, room_camera, photo):
    T_map_odom = make_pose(so3_exp(np.array([0.1, -0.2, 2.0])), [4.0, 5.0, -1.0])
    with running_localizer(map__path=room_map_file) as process, connected_client() as client:
        static = tf2_ros.StaticTransformBroadcaster(client.node)
        static.sendTransform(transform_stamped("map", "odom", T_map_odom, client.next_stamp()))
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(pose_stamped(invert(T_map_odom) @ photo.T_map_camera_prior, "odom"))
        image = rgb_image(photo.image)
        assert client.attempt(image).ok, process.output
        assert_close(client.pose_of(image), photo.T_map_camera)


def test_a_camera_that_tf_does_not_know(tf, room_map_file, room_camera, photo):
    with running_localizer(map__path=room_map_file, pose_frame="base"), connected_client() as client:
        client.send_camera_info(camera_info_of(room_camera))
        client.send_prior(pose_stamped(photo.T_map_camera_prior))
        image = rgb_image(photo.image)
        refused = client.attempt(image)
        assert refused.values["status"] == "refused"
        assert "tf has no transform from 'base_link' to 'camera_optical'" in refused.reason
        assert client.pose_of(image) is None


def test_tf_is_not_told_of_a_map_that_nobody_aligned(tf, room_map_file):
    assert_start_fails("publish_tf needs map.aligned", map__path=room_map_file, publish_tf=True)


@pytest.mark.skipif(HAS_TF2, reason="tf2_ros is installed here")
def test_without_tf2_ros_it_says_what_to_install(room_map_file):
    assert_start_fails("apt install ros-jazzy-tf2-ros", map__path=room_map_file, pose_frame="base")
