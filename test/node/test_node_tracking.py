"""The installed localizer going on from its own answers."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Odometry
from node_harness import TIMEOUT, assert_close, connected_client, running_localizer
from std_msgs.msg import Header

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image, stamp_of
from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp


def odometry(T_odom_base: np.ndarray, stamp, child: str) -> Odometry:
    message = Odometry(header=Header(stamp=stamp, frame_id="odom"), child_frame_id=child)
    message.pose.pose = pose_stamped(T_odom_base).pose
    return message


def test_tracking_goes_on_from_answers_carried_by_odometry(room_map_file, room_camera, room_photos):
    """Two photos far apart, one prior: the second is found by the odometry, and without it not."""
    first, second = (
        room_photos[0],
        max(room_photos, key=lambda q: np.linalg.norm((invert(room_photos[0].T_map_camera) @ q.T_map_camera)[:3, 3])),
    )
    drift = make_pose(so3_exp(np.array([0.0, 0.02, 0.0])), [0.05, 0.0, 0.0])
    # An answer is believed only near to what it started from.
    near = {"localizer__prior_translation": 0.05, "localizer__prior_rotation": 1.0, "localizer__max_deviation": 4.0}
    with running_localizer(map__path=room_map_file, track=True, **near) as process, connected_client() as client:
        client.send_camera_info(camera_info_of(room_camera))
        prior = pose_stamped(first.T_map_camera)
        for carried in (True, False):
            image = rgb_image(first.image)
            image.header.stamp = client.next_stamp()
            prior.header.stamp = image.header.stamp
            client.send_prior(prior)
            if carried:
                client.publish("odom", odometry(np.eye(4), image.header.stamp, "camera_optical"))
            client.send_image(image)
            assert client.spin_until(lambda image=image: stamp_of(image) in client.poses), process.output
            later = rgb_image(second.image)
            later.header.stamp = client.next_stamp()
            if carried:
                moved = invert(first.T_map_camera) @ second.T_map_camera @ drift
                client.publish("odom", odometry(moved, later.header.stamp, "camera_optical"))
            client.send_image(later)
            assert client.is_tried(later, TIMEOUT)
            pose = client.pose_of(later)
            if carried:
                assert_close(pose, second.T_map_camera)
            else:
                assert pose is None
