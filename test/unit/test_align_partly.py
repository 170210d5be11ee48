"""The parts of a similarity that gravity, the floor, a distance or a target tell."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from bags import TOPICS, camera_info, image, write_messages
from drives import random_similarity, write_tum
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import one_gaussian

from gsfeatloc_ros.align.fit import UndeterminedError
from gsfeatloc_ros.align.gravity import Up
from gsfeatloc_ros.align.level import level
from gsfeatloc_ros.align.pairs import Answer
from gsfeatloc_ros.align.target import FAMILIES, Checkerboard, Tags, View
from gsfeatloc_ros.align.target_fit import fit_targets, scale_by_targets
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, quaternion_from_matrix, so3_exp
from gsfeatloc_ros.common.parameter import settings_from
from gsfeatloc_ros.inspect.floor import find_floor
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.ros_io.parameter_file import read_parameter_file
from gsfeatloc_ros.simulate.bag_messages import header, make
from gsfeatloc_ros.tools.align import main

few = settings(deadline=None, max_examples=5)
TAG_CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]))
# In the map's frame, turned and 1.7 units to a metre.
S_MAP_TAG = Similarity(1.7, so3_exp(np.array([0.4, -0.3, 1.0])), np.array([0.5, -0.2, 1.0]))


def placed(path) -> Similarity:
    return settings_from(MapSettings, read_parameter_file(path), "map.").alignment()


def where(map_: Similarity) -> list[str]:
    numbers = [f"{value:.12f}" for value in (*map_.translation, *quaternion_from_matrix(map_.rotation))]
    return ["--map-scale", f"{map_.scale:.12f}", "--map-translation", *numbers[:3], "--map-rotation", *numbers[3:]]


@few
@given(st.integers(0, 10**6), st.floats(0.01, 100))
def test_a_floor_is_found_below_a_table_whatever_the_unit(seed, unit):
    rng = np.random.default_rng(seed)
    floor, table = (
        rng.uniform([-3, -3, z], [3, 3, z], (n, 3)) * [s, s, 1] for z, n, s in ((0, 400, 1), (0.8, 300, 0.2))
    )
    walls, haze = rng.uniform([3, -3, 0], [3.1, 3, 3], (400, 3)), rng.uniform([-4, -4, -1], [4, 4, 3], (30, 3))
    areas = np.repeat([1.0, 0.05, 1.0, 0.1], [400, 300, 400, 30])
    S = Similarity(unit, so3_exp(rng.uniform(-2, 2, 3)), rng.normal(0, 5 * unit, 3))
    points = S.transform(np.concatenate([floor, table, walls, haze]) + rng.normal(0, 0.003, (1130, 3)))
    cameras = S.transform(rng.uniform([-1, -1, 1.2], [1, 1, 1.4], (5, 3)))
    up = S.rotation @ so3_exp(rng.normal(0, 0.02, 3)) @ [0, 0, 1]
    found = find_floor(points, areas, cameras, up)
    assert np.degrees(np.arccos(min(1, found.normal @ S.rotation[:, 2]))) < 1.0
    assert abs(S.inverse().transform(found.point[None])[0, 2]) < 0.03


def test_without_gaussians_below_there_is_no_floor():
    up = np.array([0, 0, 1.0])
    assert find_floor(np.zeros((0, 3)), np.zeros(0), np.ones((1, 3)), up) is None
    below = Answer(0, np.eye(4), np.zeros(2))
    with pytest.raises(UndeterminedError, match="no level plane below the cameras"):
        level(Up(up, 0.0, 1), one_gaussian([0, 0, 5.0], 0.1, 0.9), [below], by_floor=False, metres=False)


@pytest.mark.parametrize("by", ["level", "imu"])
def test_gravity_and_floor_level_the_map(by, room_map_file, room_photos, tmp_path, capsys):
    rng = np.random.default_rng(0)
    now = replace(random_similarity(rng), scale=1.3)
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    cameras = [photo.T_map_camera for photo in room_photos]
    if by == "level":
        headings = np.linspace(0, 6, len(cameras))
        cameras = [
            make_pose(so3_exp(np.array([0, 0, h])) @ ahead, T[:3, 3]) for h, T in zip(headings, cameras, strict=True)
        ]
    answers = write_tum(tmp_path / "answers.tum", np.array([now.transform_pose(pose) for pose in cameras]))
    arguments = ["gravity", "--map", str(room_map_file), *where(now), "--answers", str(answers)]
    arguments += ["--out", str(tmp_path / "map.yaml")]
    if by == "imu":
        T_imu_camera = make_pose(so3_exp(rng.normal(size=3)), [0.1, 0, 0])
        readings = [
            (stamp, T_imu_camera[:3, :3] @ T[:3, :3].T @ [0, 0, 9.81] + rng.normal(0, 0.05, 3))
            for number, T in enumerate(cameras)
            for stamp in 100 + number + np.linspace(-0.1, 0.1, 9)
        ]
        bag = write_messages(tmp_path / "bag", [("/imu", imu(stamp, force)) for stamp, force in readings])
        mounted = [f"{x:.9f}" for x in (*T_imu_camera[:3, 3], *quaternion_from_matrix(T_imu_camera[:3, :3]))]
        arguments += ["--bag", str(bag), "--imu", "/imu", "--extrinsics", *mounted]
    else:
        arguments += ["--level", "--up", "floor"]
    assert main(arguments) == 0
    found = placed(tmp_path / "map.yaml")
    assert found.scale == pytest.approx(1.3)
    assert np.degrees(np.arccos(min(1, found.rotation[2, 2]))) < 0.3
    assert np.abs(found.transform(np.zeros((1, 3)))[0, 2]) < 0.02
    assert "units above it" in capsys.readouterr().out


def imu(stamp: float, force: np.ndarray, variance: float = 0.0):
    zero, unknown = make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0), np.zeros(9)
    return make(
        "sensor_msgs/msg/Imu",
        header=header(stamp, "imu"),
        orientation=make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
        orientation_covariance=unknown,
        angular_velocity=zero,
        angular_velocity_covariance=unknown,
        linear_acceleration=make("geometry_msgs/msg/Vector3", *force.tolist()),
        linear_acceleration_covariance=np.full(9, variance),
    )


def test_what_does_not_tell_up_is_refused(room_map_file, room_photos, tmp_path, capsys):
    poses = np.array([photo.T_map_camera for photo in room_photos])
    common = ["--map", str(room_map_file), "--answers", str(write_tum(tmp_path / "answers.tum", poses))]
    common += ["--out", str(tmp_path / "map.yaml")]
    silent = write_messages(tmp_path / "silent", [("/imu", imu(100.0, np.zeros(3), -1.0))])
    falling = write_messages(tmp_path / "falling", [("/imu", imu(100.0, np.zeros(3)))])
    rolled = np.array(
        [pose @ make_pose(so3_exp(np.array([0, 0, a])), [0, 0, 0]) for pose, a in zip(poses, range(8), strict=True)]
    )
    write_tum(tmp_path / "rolled.tum", rolled)
    mounted = ["--imu", "/imu", "--extrinsics", *"0000001"]
    for arguments, status, complaint in [
        ([], 2, "say what tells up"),
        (["--bag", str(silent), *mounted], 2, "no accelerations"),
        (["--bag", str(falling), *mounted], 1, "no photo tells what is up"),
        (["--bag", str(falling), "--imu", "/other", "--extrinsics", *"0000001"], 2, "/other"),
        (["--level", "--answers", str(tmp_path / "rolled.tum")], 1, "what is up only to"),
    ]:
        assert main(["gravity", *common, *arguments]) == status, complaint
        said = capsys.readouterr().err
        assert complaint in said
        assert said.count("\n") == 1
    assert not (tmp_path / "map.yaml").exists()


def test_a_distance_between_points_scales_what_lies_already(tmp_path, capsys):
    first, second = tmp_path / "a.yaml", tmp_path / "b.yaml"
    now = where(Similarity(2.0, so3_exp(np.array([0, 0, 0.5])), np.array([1.0, 2.0, 3.0])))
    assert main(["distance", "--points", *"000034", "--distance", "10", "--out", str(first), *now]) == 0
    assert placed(first).scale == pytest.approx(4)
    np.testing.assert_allclose(placed(first).translation, [2, 4, 6])
    arguments = ["distance", "--points", *"000010", "--distance", "0.5", "--out", str(second)]
    assert main([*arguments, "--params-file", str(first)]) == 0
    assert placed(second).scale == pytest.approx(2)
    assert read_parameter_file(second)["map.aligned"] is False
    capsys.readouterr()
    assert main(["distance", "--points", *"000000", "--distance", "1", "--out", str(first)]) == 2
    assert "the two points are the same" in capsys.readouterr().err


def test_a_distance_between_pixels(room, room_camera, room_photos, room_map_file, tmp_path, capsys):
    poses = np.array([photo.T_map_camera for photo in room_photos[:2]])
    answers = write_tum(tmp_path / "answers.tum", poses)
    calibration = {
        "image_width": 640,
        "image_height": 480,
        "distortion_model": "plumb_bob",
        "camera_matrix": {"data": room_camera.K.ravel().tolist()},
        "distortion_coefficients": {"data": room_camera.distortion.tolist()},
    }
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(calibration))
    points, pixels = [], [(200, 150), (420, 300)]
    for pose, (u, v) in zip(poses, pixels, strict=True):
        ray = room_camera.rays(room_camera.undistort(np.array([[u, v]])))[0]
        points.append(pose[:3, :3] @ (ray * room.ray_trace(room_camera, pose, 1).depth[v, u]) + pose[:3, 3])
    metres = float(np.linalg.norm(points[1] - points[0]))
    arguments = ["distance", "--map", str(room_map_file), "--answers", str(answers), "--distance", str(metres)]
    arguments += ["--calibration", str(tmp_path / "camera.yaml"), "--out", str(tmp_path / "map.yaml"), "--pixels"]
    assert main([*arguments, "100", *map(str, pixels[0]), "101", *map(str, pixels[1])]) == 0
    assert placed(tmp_path / "map.yaml").scale == pytest.approx(1, abs=0.01)
    assert "standard deviation by the map's depth" in capsys.readouterr().out
    assert main([*arguments, "100", "200", "150", "150", "420", "300"]) == 2
    assert "no photo of 150.000 was localized" in capsys.readouterr().err


def looking_at_tag(rng: np.random.Generator) -> np.ndarray:
    """Return T_map_camera (4, 4) of a camera half a metre to a metre before the tag."""
    position = np.array([*rng.uniform(-0.4, 0.4, 2), rng.uniform(0.6, 1.0)])
    forward = (rng.normal(0, 0.05, 3) - position) / np.linalg.norm(position)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return S_MAP_TAG.transform_pose(make_pose(np.column_stack([right, np.cross(forward, right), forward]), position))


def photo_of(picture: np.ndarray, width: float, T_map_camera: np.ndarray) -> np.ndarray:
    """Return the photo (H, W, 3) of a picture, `width` metres wide, whose middle is the tag's."""
    T_tag_camera = S_MAP_TAG.inverse().transform_pose(T_map_camera)
    R, t = T_tag_camera[:3, :3].T, -T_tag_camera[:3, :3].T @ T_tag_camera[:3, 3]
    metres = width / picture.shape[1]
    rows, columns = picture.shape
    to_plane = np.array([[metres, 0, -metres * (columns - 1) / 2], [0, -metres, metres * (rows - 1) / 2], [0, 0, 1]])
    H = TAG_CAMERA.K @ np.column_stack([R[:, 0], R[:, 1], t]) @ to_plane
    gray = cv2.warpPerspective(picture, H, (640, 480), flags=cv2.INTER_AREA, borderValue=255)
    return np.repeat(cv2.GaussianBlur(gray, (0, 0), 0.7)[:, :, None], 3, axis=2)


def tag_picture() -> np.ndarray:
    """Return tag 5 of 36h11 with a white margin: 8 of 10 parts are the tag."""
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES["36h11"])
    return cv2.copyMakeBorder(
        cv2.aruco.generateImageMarker(dictionary, 5, 320), *[40] * 4, cv2.BORDER_CONSTANT, value=255
    )


def board_picture() -> np.ndarray:
    squares = (np.indices((7, 8)).sum(axis=0) % 2 * 255).astype(np.uint8)
    return cv2.copyMakeBorder(np.kron(squares, np.ones((50, 50), np.uint8)), *[50] * 4, cv2.BORDER_CONSTANT, value=255)


def views(picture: np.ndarray, width: float, count: int = 6) -> list[View]:
    rng = np.random.default_rng(0)
    poses = [looking_at_tag(rng) for _ in range(count)]
    return [View(photo_of(picture, width, pose), TAG_CAMERA, pose) for pose in poses]


def test_a_tag_tells_scale_and_place():
    tags = Tags("36h11", 0.2)
    seen = [sighting for view in views(tag_picture(), 0.25) for sighting in tags.find(view)]
    assert len(seen) == 6
    fit = fit_targets(tags, seen)
    assert fit.units == pytest.approx(1.7, rel=0.005)
    assert abs(np.log(fit.units / 1.7)) < 4 * fit.sigma + 1e-3
    np.testing.assert_allclose(fit.S_map_target[5].translation, S_MAP_TAG.translation, atol=0.01)
    np.testing.assert_allclose(fit.S_map_target[5].rotation, S_MAP_TAG.rotation, atol=0.02)
    assert Tags("36h11", 0.2, number=6).find(views(tag_picture(), 0.25, 1)[0]) == []


def test_a_checkerboard_tells_the_scale():
    board = Checkerboard(7, 6, 0.03)
    seen = [sighting for view in views(board_picture(), 0.3) for sighting in board.find(view)]
    assert len(seen) >= 4
    assert fit_targets(board, seen).units == pytest.approx(1.7, rel=0.005)


def test_no_target_or_one_photo_tells_nothing():
    tags = Tags("36h11", 0.2)
    with pytest.raises(UndeterminedError, match="no target was seen"):
        fit_targets(tags, [])
    (seen,) = tags.find(views(tag_picture(), 0.25, 1)[0])
    with pytest.raises(UndeterminedError, match="at least 2 photos"):
        fit_targets(tags, [seen])
    with pytest.raises(UndeterminedError, match=r"tell the scale only to|from one place"):
        scale_by_targets(fit_targets(tags, [seen, seen]), 0.01, None)


def test_a_tag_in_a_bag_gives_the_robots_frame(tmp_path, capsys):
    photos = views(tag_picture(), 0.25, 5)
    messages = [("/info", camera_info(99.0, TAG_CAMERA))]
    messages += [(TOPICS["image"], image(100.0 + number, view.image)) for number, view in enumerate(photos)]
    bag = write_messages(tmp_path / "bag", messages)
    answers = write_tum(tmp_path / "answers.tum", np.array([view.T_map_camera for view in photos]))
    T_robot_tag = make_pose(so3_exp(np.array([0.1, 0.2, 0.3])), [1.0, 2.0, 0.5])
    pose = [f"{x:.9f}" for x in (*T_robot_tag[:3, 3], *quaternion_from_matrix(T_robot_tag[:3, :3]))]
    arguments = ["target", "--bag", str(bag), "--image", TOPICS["image"], "--answers", str(answers)]
    arguments += ["--size", "0.2", "--out", str(tmp_path / "map.yaml"), "--camera-info", "/info"]
    assert main([*arguments, "--tag", "36h11", "--tag-pose", *pose]) == 0
    truth = Similarity(1.0, T_robot_tag[:3, :3], T_robot_tag[:3, 3]) @ S_MAP_TAG.inverse()
    found = placed(tmp_path / "map.yaml")
    assert found.scale == pytest.approx(truth.scale, rel=0.005)
    np.testing.assert_allclose(found.translation, truth.translation, atol=0.02)
    capsys.readouterr()
    assert main([*arguments, "--tag", "16h5"]) == 1
    assert "no target was seen" in capsys.readouterr().err
    assert main(arguments) == 2
    assert "name the target" in capsys.readouterr().err
