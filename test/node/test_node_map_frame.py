"""The installed localizer with a map whose file is in another frame and unit than the robot's."""

from __future__ import annotations

import numpy as np
import pytest
from node_harness import assert_start_fails, connected_client, running_localizer

from gsfeatloc_ros.align.alignment import write_parameters
from gsfeatloc_ros.client.messages import camera_info_of, pose_matrix, pose_stamped, rgb_image
from gsfeatloc_ros.common.geometry import quaternion_from_matrix, rotation_error_deg, so3_exp, translation_error
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.maps import Similarity
from gsfeatloc_ros.tools import prepare

# Of the room's file in the robot's frame.
ALIGNMENT = Similarity(2.5, so3_exp(np.array([0.4, -1.1, 2.0])), np.array([12.0, -7.0, 3.0]))


def numbers(values) -> str:
    return str([float(value) for value in values])


@pytest.mark.parametrize("how", ["by parameters", "by a bundle"])
def test_answers_are_in_the_frame_of_the_robot(room_map_file, room_camera, room_photos, how, tmp_path):
    parameters = {
        "map__path": room_map_file,
        "map__scale": ALIGNMENT.scale,
        "map__rotation": numbers(quaternion_from_matrix(ALIGNMENT.rotation)),
        "map__translation": numbers(ALIGNMENT.translation),
    }
    if how == "by a bundle":
        rotation = tuple(quaternion_from_matrix(ALIGNMENT.rotation).tolist())
        placed = MapSettings(
            scale=ALIGNMENT.scale, translation=tuple(ALIGNMENT.translation.tolist()), rotation=rotation
        )
        write_parameters(tmp_path / "align.yaml", placed, [])
        made = ["--align", str(tmp_path / "align.yaml"), "--out", str(tmp_path / "room"), "--views", "3"]
        assert prepare.main([str(room_map_file), *made, "--skip-inspection"]) == 0
        parameters = {"map__path": tmp_path / "room"}
    parameters |= {"matcher__name": "sift", "localizer__prior_translation": 1.25}
    with running_localizer(**parameters) as process, connected_client() as client:
        client.send_camera_info(camera_info_of(room_camera))
        for photo in room_photos[:2]:
            client.send_prior(pose_stamped(ALIGNMENT.transform_pose(photo.T_map_camera_prior)))
            message = rgb_image(photo.image)
            answer = client.attempt(message)
            assert answer.ok, f"{answer.reason}\n{process.output}"
            pose, truth = pose_matrix(client.pose_of(message)), ALIGNMENT.transform_pose(photo.T_map_camera)
            assert rotation_error_deg(pose, truth) < 1.0
            assert translation_error(pose, truth) < 0.02 * ALIGNMENT.scale


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("map__scale", "0.0", "map.scale"),
        ("map__rotation", "[0.0, .inf, 0.0, 1.0]", "parameter map.rotation: [0.0, inf, 0.0, 1.0] is not 4 finite"),
        ("map__dataparser_transforms", "/nowhere/transforms.json", "/nowhere/transforms.json: cannot be read"),
    ],
)
def test_frame_that_is_none_ends_the_start_with_one_line(room_map_file, name, value, says):
    assert_start_fails(says, map__path=room_map_file, **{name: value})
