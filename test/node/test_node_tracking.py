"""The installed localizer going on from its own answers."""

from __future__ import annotations

import numpy as np
from node_harness import TIMEOUT, assert_close, connected_client, odometry, running_localizer

from gsfeatloc_ros.client.messages import camera_info_of, pose_stamped, rgb_image, stamp_of
from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp


def test_tracking_goes_on_from_answers_carried_by_odometry(room_map_file, room_camera, room_photos):
    """Two photos far apart, one prior: odometry says where the second is; without it the search is wider."""
    first, second = (
        room_photos[0],
        max(room_photos, key=lambda q: np.linalg.norm((invert(room_photos[0].T_map_camera) @ q.T_map_camera)[:3, 3])),
    )
    drift = make_pose(so3_exp(np.array([0.0, 0.02, 0.0])), [0.05, 0.0, 0.0])
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
            assert_close(client.pose_of(later), second.T_map_camera)
            tried = next(d for d in client.diagnostics if d.values.get("stamp") == stamp_of(later))
            assert tried.values["prior"] == "last answer"
            assert (float(tried.values["prior_sigma"]) < 0.5) == carried
