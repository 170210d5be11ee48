"""A map that was trained in another frame and unit than the robot's."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import (
    make_pose,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_error_deg,
    so3_exp,
    transform,
    translation_error,
)
from gsfeatloc_ros.localize.estimate import Status
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.maps import GaussianMap, MapError, Similarity, load_map, read_dataparser_transforms
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.render.reference import ReferenceRenderer
from gsfeatloc_ros.ros_io.settings import Settings

CAMERA = Camera(75, 53, np.array([[70.0, 0, 34], [0, 66.0, 27], [0, 0, 1]]))


def random_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    return Similarity(np.exp(rng.uniform(-2, 2)), so3_exp(rng.normal(size=3)), rng.uniform(-20, 20, 3))


def random_map(seed: int) -> GaussianMap:
    """Gaussians of SH degree 1 ahead of the origin, so opaque that enough pixels have a depth."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(300, 4))
    return GaussianMap(
        means=rng.uniform([-3, -2, 1], [3, 2, 6], (300, 3)).astype(np.float32),
        scales=np.exp(rng.uniform(-5, -0.5, (300, 3))).astype(np.float32),
        rotations=(rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        opacities=rng.uniform(0.4, 1, 300).astype(np.float32),
        sh=rng.normal(scale=0.3, size=(300, 4, 3)).astype(np.float32),
    )


def trained_elsewhere(gaussian_map: GaussianMap, S_map_splat: Similarity) -> GaussianMap:
    """The same Gaussians as if they had been trained in another frame, of which S_map_splat is known."""
    S = S_map_splat.inverse()
    turned = [S.rotation @ matrix_from_quaternion(q) for q in np.roll(gaussian_map.rotations, -1, axis=1)]
    rotations = np.roll([quaternion_from_matrix(rotation) for rotation in turned], 1, axis=1)
    sh = gaussian_map.sh.astype(np.float64)
    if sh.shape[1] > 1:
        # Degree 1 is a vector for each channel: its harmonics are -y, z and -x.
        vectors = np.stack([-sh[:, 3], -sh[:, 1], sh[:, 2]], axis=1)
        x, y, z = np.moveaxis(np.einsum("ij,njc->nic", S.rotation, vectors), 1, 0)
        sh = np.stack([sh[:, 0], -y, z, -x], axis=1)
    return GaussianMap(
        means=S.transform(gaussian_map.means.astype(np.float64)).astype(np.float32),
        scales=(S.scale * gaussian_map.scales).astype(np.float32),
        rotations=rotations.astype(np.float32),
        opacities=gaussian_map.opacities,
        sh=sh.astype(np.float32),
        S_map_splat=S_map_splat,
    )


@given(a=st.integers(0, 1000), b=st.integers(0, 1000))
def test_similarities_chain_and_invert(a, b):
    S_a_b, S_b_c = random_similarity(a), random_similarity(b)
    points = np.random.default_rng(a).normal(size=(5, 3))
    np.testing.assert_allclose((S_a_b @ S_b_c).transform(points), S_a_b.transform(S_b_c.transform(points)), atol=1e-9)
    np.testing.assert_allclose(S_a_b.inverse().transform(S_a_b.transform(points)), points, atol=1e-9)
    np.testing.assert_allclose(
        S_a_b.transform(points), S_a_b.scale * (S_a_b.rotation @ points.T).T + S_a_b.translation, atol=1e-9
    )


@given(seed=st.integers(0, 1000))
def test_a_pose_keeps_what_the_camera_sees_but_for_the_unit(seed):
    S_a_b = random_similarity(seed)
    T_b_camera = make_pose(so3_exp(np.array([0.3, -0.2, 0.9])), np.array([1.0, 2.0, 3.0]))
    points = np.random.default_rng(seed).normal(size=(5, 3))  # camera frame, unit of b
    np.testing.assert_allclose(
        transform(S_a_b.transform_pose(T_b_camera), S_a_b.scale * points),
        S_a_b.transform(transform(T_b_camera, points)),
        atol=1e-9,
    )


@pytest.mark.parametrize(
    ("scale", "rotation", "translation", "match"),
    [
        (0.0, np.eye(3), np.zeros(3), "not a positive number"),
        (-1.0, np.eye(3), np.zeros(3), "not a positive number"),
        (np.nan, np.eye(3), np.zeros(3), "not a positive number"),
        (np.inf, np.eye(3), np.zeros(3), "not a positive number"),
        (1.0, 2 * np.eye(3), np.zeros(3), "not a rotation"),
        (1.0, np.full((3, 3), np.nan), np.zeros(3), "not a rotation"),
        (1.0, np.eye(4), np.zeros(3), "not a rotation"),
        (1.0, np.diag([1.0, 1.0, -1.0]), np.zeros(3), "mirrors"),
        (1.0, np.eye(3), np.array([0, np.inf, 0]), "not three finite numbers"),
        (1.0, np.eye(3), np.zeros(2), "not three finite numbers"),
    ],
)
def test_what_is_no_similarity_is_refused(scale, rotation, translation, match):
    with pytest.raises(ValueError, match=match):
        Similarity(scale, rotation, translation)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("map.scale", 0.0, "map.scale"),
        ("map.scale", -1.0, "map.scale"),
        ("map.translation", [1.0, 2.0], "parameter map.translation: [1.0, 2.0] is not 3 finite numbers"),
        ("map.translation", [1.0, 2.0, np.nan], "parameter map.translation: [1.0, 2.0, nan] is not 3 finite numbers"),
        ("map.rotation", [0.0, 0.0, 1.0], "parameter map.rotation: [0.0, 0.0, 1.0] is not 4 finite numbers"),
        ("map.rotation", [0.0, 0.0, 0.0, 0.0], "parameter map.rotation: quaternion [0.0, 0.0, 0.0, 0.0] has no"),
    ],
)
def test_parameters_of_a_frame_that_is_none_are_refused(name, value, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        Settings.checked({"map.path": "room.ply", name: value}).map.alignment()


# Rendering


@pytest.mark.slow
@pytest.mark.parametrize("make_renderer", [create_renderer, ReferenceRenderer])
@pytest.mark.parametrize("antialiased", [False, True])
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_map_trained_elsewhere_looks_the_same_from_the_robots_frame(make_renderer, antialiased, seed):
    here = replace(random_map(seed), antialiased=antialiased)
    elsewhere = replace(trained_elsewhere(here, random_similarity(seed)), antialiased=antialiased)
    pose = make_pose(so3_exp(np.array([0.1, -0.2, 0.05])), np.array([0.3, -0.2, -0.5]))
    a, b = (make_renderer(gaussian_map).render(CAMERA, pose) for gaussian_map in (here, elsewhere))
    # But for splats that are at the least alpha that counts: rounding decides on those.
    difference = np.abs(a.rgb.astype(np.float64) - b.rgb)
    assert np.quantile(difference, 0.9) < 1e-4
    assert difference.max() < 0.1
    for name in ("depth", "median_depth", "depth_std"):
        x, y = getattr(a, name), getattr(b, name)
        both = np.isfinite(x) & np.isfinite(y)
        assert both.mean() > 0.3
        assert np.quantile(np.abs(x - y)[both] / a.depth[both], 0.98) < 1e-3, name


def test_the_robots_own_frame_changes_nothing():
    gaussian_map = random_map(0)
    a = create_renderer(gaussian_map).render(CAMERA, np.eye(4))
    b = create_renderer(replace(gaussian_map, S_map_splat=Similarity())).render(CAMERA, np.eye(4))
    for name in ("rgb", "depth", "depth_std", "alpha"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.nightly)])
def test_answers_are_in_the_robots_frame(room_map, room_camera, room_photos, seed):
    S_map_splat = random_similarity(seed)
    here = Localizer(create_renderer(room_map), create_matcher("sift"))
    elsewhere = Localizer(create_renderer(trained_elsewhere(room_map, S_map_splat)), create_matcher("sift"))
    for photo in room_photos[:2]:
        a, b = (x.localize(photo.image, room_camera, photo.T_map_camera_prior) for x in (here, elsewhere))
        assert a.status is b.status is Status.LOCALIZED
        assert rotation_error_deg(a.T_map_camera, b.T_map_camera) < 0.1
        assert translation_error(a.T_map_camera, b.T_map_camera) < 0.005
        assert rotation_error_deg(b.T_map_camera, photo.T_map_camera) < 1.0
        assert translation_error(b.T_map_camera, photo.T_map_camera) < 0.02
        np.testing.assert_allclose(np.diag(b.covariance), np.diag(a.covariance), rtol=0.3)


def test_a_map_is_loaded_with_its_alignment(room_map_file):
    assert load_map(room_map_file).S_map_splat.scale == 1.0
    alignment = random_similarity(0)
    placed = load_map(room_map_file, alignment).S_map_splat
    assert placed.scale == alignment.scale
    np.testing.assert_array_equal(placed.rotation, alignment.rotation)
    np.testing.assert_array_equal(placed.translation, alignment.translation)


# nerfstudio


def test_nerfstudios_transforms_lead_back_to_the_frame_of_its_data(tmp_path):
    rotation, translation, scale = so3_exp(np.array([0.5, 1.0, -0.3])), np.array([1.0, -2.0, 0.5]), 0.137
    written = {"transform": np.column_stack([rotation, translation]).tolist(), "scale": scale}
    path = tmp_path / "dataparser_transforms.json"
    path.write_text(json.dumps(written))
    data = np.random.default_rng(0).normal(size=(10, 3))
    # As nerfstudio moves its cameras: by the transform, then their positions are scaled about the origin.
    splat = np.array([scale * (np.array(written["transform"]) @ [*point, 1.0]) for point in data])
    S_map_splat = read_dataparser_transforms(path)
    np.testing.assert_allclose(S_map_splat.transform(splat), data, atol=1e-12)
    assert S_map_splat.scale == pytest.approx(1 / scale)


LARGE_SCALE = f'{{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1{400 * "0"}}}'


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("", "is not a dataparser_transforms"),
        ("[]", "is not a dataparser_transforms"),
        ("{}", "'transform'"),
        ('{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}', "'scale'"),
        ('{"transform": [[1, 0], [0, 1]], "scale": 1}', r"shape \(2, 2\)"),
        ('{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0}', "not a positive number"),
        ('{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 2, 0]], "scale": 1}', "not a rotation"),
        ('{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, NaN]], "scale": 1}', "finite"),
        ("[" * 100_000, "is not a dataparser_transforms"),
        # Integers of JSON are of any size.
        (LARGE_SCALE, "not a positive number"),
        (LARGE_SCALE.replace("[[1,", f"[[1{400 * '0'},"), "is not a dataparser_transforms"),
    ],
)
def test_other_files_than_nerfstudios_transforms_are_refused(tmp_path, content, match):
    path = tmp_path / "dataparser_transforms.json"
    path.write_text(content)
    with pytest.raises(MapError, match=match) as error:
        read_dataparser_transforms(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("digits", [19, 400, 5000])
def test_a_number_of_very_many_digits_is_refused(tmp_path, digits):
    """Python's whole numbers have no end, floats do; that ended the node without a word."""
    path = tmp_path / "dataparser_transforms.json"
    content = {"transform": np.eye(4)[:3].tolist(), "scale": 1.0}
    path.write_text(json.dumps(content).replace("0.0", digits * "9", 1))
    with pytest.raises(MapError, match="is not a dataparser_transforms"):
        read_dataparser_transforms(path)


def test_transforms_in_a_pipe_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "transforms.json")
    with pytest.raises(MapError, match="is not a regular file"):
        read_dataparser_transforms(tmp_path / "transforms.json")


def test_missing_transforms(tmp_path):
    with pytest.raises(MapError, match="No such file"):
        read_dataparser_transforms(tmp_path / "dataparser_transforms.json")
