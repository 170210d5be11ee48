"""Bags, priors and scenes that people brought, made after public reports."""

from __future__ import annotations

import numpy as np
import pytest

from gsfeatloc_ros.evaluate.priors_file import read_priors
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.replay.bag import Role, open_bag

ROLES = {
    Role.IMAGE: ["/camera/image_raw"],
    Role.CAMERA_INFO: ["/camera/camera_info"],
    Role.PRIOR: ["/prior"],
    Role.TF: ["/tf"],
}


@pytest.mark.parametrize("name", ["service_events", "service_events/service_events.mcap", "bags/m_json.mcap"])
def test_of_a_bag_what_was_asked_for_is_read(cases, name):
    with open_bag(cases / name, ROLES) as bag:
        recorded = list(bag.messages())
        assert bag.images == sum(each.role is Role.IMAGE for each in recorded) > 0
    assert {each.role for each in recorded} == {Role.IMAGE, Role.CAMERA_INFO, Role.PRIOR}
    assert not any(each.problem for each in recorded)


def test_priors_with_a_byte_order_mark(cases, scenes):
    assert len(read_priors(cases / "priors_bom.txt", load_scene(scenes / "bonsai"))) == 3


@pytest.fixture
def bonsai_with(cases, scenes, tmp_path):
    """Return the function that makes bonsai with other transforms."""

    def make(name: str):
        for part in ("images", "map.ply"):
            (tmp_path / part).symlink_to(scenes / "bonsai" / part)
        (tmp_path / "transforms.json").write_bytes((cases / "transforms" / name).read_bytes())
        return load_scene(tmp_path)

    return make


def test_intrinsics_of_each_frame(bonsai_with, scenes):
    scene, plain = bonsai_with("perframe.json"), load_scene(scenes / "bonsai")
    for photo, expected in zip(scene.photos, plain.photos, strict=True):
        assert photo.name == expected.name
        np.testing.assert_array_equal(photo.camera.K, expected.camera.K)
        np.testing.assert_array_equal(photo.T_map_camera, expected.T_map_camera)


def test_without_a_split_every_eighth_photo_is_for_testing(bonsai_with, scenes):
    scene, plain = bonsai_with("nosplit.json"), load_scene(scenes / "bonsai")
    assert [photo.name for photo in scene.photos] == [photo.name for photo in plain.photos]


def test_a_fisheye_that_is_none_is_refused_by_name(bonsai_with):
    with pytest.raises(
        ValueError, match="is_fisheye is true, but camera_model is OPENCV: remove the one that is wrong"
    ):
        bonsai_with("isfish.json")
