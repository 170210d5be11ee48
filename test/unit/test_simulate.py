"""The simulated room: its ray tracer, its photos, its map and its bag."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion, rotation_error_deg, translation_error
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.simulate import Room, simulate_photos, write_bag
from gsfeatloc_ros.simulate.photos import MIN_CLEARANCE, PRIOR_ROTATION_DEG, PRIOR_TRANSLATION, Walk, facing
from gsfeatloc_ros.simulate.room import pixel_rays
from gsfeatloc_ros.simulate.room_camera import RoomCamera
from gsfeatloc_ros.simulate.solids import Box, Sphere

BOX = Box(np.array([0.5, -0.2, 0.3]), np.array([1.0, 0.6, 0.8]), yaw=0.4)
SPHERE = Sphere(np.array([0.5, -0.2, 0.3]), 0.7)
solids = pytest.mark.parametrize("solid", [BOX, SPHERE], ids=["box", "sphere"])

coordinates = st.floats(-3, 3)
points = st.tuples(coordinates, coordinates, coordinates).map(np.array)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


# The solids


def test_ray_meets_the_near_face_of_a_box():
    box = Box(np.array([2.0, 0.0, 0.0]), np.ones(3))
    directions = np.array([[1.0, 0, 0], [2.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0]])
    np.testing.assert_allclose(box.intersect(np.zeros(3), directions), [1.5, 0.75, np.inf, np.inf])


def test_ray_from_inside_meets_a_solid_where_it_leaves():
    directions = np.array([[0.0, 0, 1], [0.0, 0, -1]])
    np.testing.assert_allclose(BOX.intersect(BOX.centre, directions), [0.4, 0.4])
    np.testing.assert_allclose(SPHERE.intersect(SPHERE.centre, directions), [0.7, 0.7])


def test_ray_meets_a_sphere_as_the_quadratic_formula_says():
    sphere = Sphere(np.array([4.0, 0.0, 0.0]), 1.0)
    directions = np.array([[1.0, 0, 0], [1.0, 0.2, 0], [1.0, 0.5, 0]])
    # |t (1, 0.2) - (4, 0)| = 1 for the second; the third passes by.
    expected = [3.0, (8 - np.sqrt(64 - 4 * 1.04 * 15)) / (2 * 1.04), np.inf]
    np.testing.assert_allclose(sphere.intersect(np.zeros(3), directions), expected)


@solids
@given(origin=points, direction=points)
def test_ray_ends_where_the_distance_first_is_zero(solid, origin, direction):
    length = np.linalg.norm(direction)
    assume(length > 0.1 and abs(solid.distance(origin[None])[0]) > 1e-3)
    direction = direction / length
    (t,) = solid.intersect(origin, direction[None])
    before = origin + np.linspace(0, min(t, 10.0), 500)[:-1, None] * direction
    outside = solid.distance(origin[None])[0] > 0
    distances = solid.distance(before) if outside else -solid.distance(before)
    assert (distances > -1e-9).all()
    if np.isfinite(t):
        np.testing.assert_allclose(solid.distance((origin + t * direction)[None]), 0, atol=1e-9)


@solids
@given(face=st.integers(0, 5), u=st.floats(-0.99, 0.99), v=st.floats(-0.99, 0.99))
def test_place_on_a_face_is_found_again(solid, face, u, v):
    surface, normals = solid.face_points(face, np.array([[u, v]]))
    np.testing.assert_allclose(solid.distance(surface), 0, atol=1e-12)
    np.testing.assert_allclose(solid.distance(surface + 0.01 * normals), 0.01, atol=1e-9)
    faces, uv = solid.locate(surface)
    assert faces[0] == face
    np.testing.assert_allclose(uv, [[u, v]], atol=1e-9)


# The ray tracer


def test_ceiling_is_seen_at_its_height_and_in_its_colours(room, room_camera):
    """A camera under the bare ceiling, its axes those of the map, z up."""
    pose = make_pose(np.eye(3), np.array([1.4, 1.1, 2.0]))
    trace = room.ray_trace(room_camera, pose, samples=1)
    np.testing.assert_allclose(trace.depth, 1.0, atol=1e-5)
    # From the observed pixel to the ceiling, one metre up, by OpenCV alone.
    rows, cols = np.mgrid[40:480:80, 40:640:80]
    pixels = np.column_stack([cols.ravel(), rows.ravel()]).astype(np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    undistorted = cv2.undistortPoints(
        pixels.reshape(-1, 1, 2), room_camera.K, room_camera.distortion, None, None, None, criteria
    ).reshape(-1, 2)
    x, y = (undistorted + np.array([1.4, 1.1])).T
    ceiling = room.pictures[0][5]
    texel_x = ((x + 3.0) / 6.0 * ceiling.shape[1] - 0.5).astype(np.float32)
    texel_y = ((y + 2.5) / 5.0 * ceiling.shape[0] - 0.5).astype(np.float32)
    expected = cv2.remap(ceiling, texel_x[None], texel_y[None], cv2.INTER_LINEAR)[0] / 255
    np.testing.assert_allclose(trace.rgb[rows.ravel(), cols.ravel()], expected, atol=3 / 255)


def test_rays_of_the_pixels_are_those_that_the_lens_bends_onto_them(room_camera):
    rays = pixel_rays(room_camera, (0.25, -0.4)).astype(np.float64)
    seen = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), room_camera.K, room_camera.distortion)[0]
    cols, rows = np.meshgrid(np.arange(room_camera.width) + 0.25, np.arange(room_camera.height) - 0.4)
    np.testing.assert_allclose(seen.reshape(*rows.shape, 2), np.stack([cols, rows], axis=-1), atol=2e-3)


def test_nearest_solid_hides_the_others(room):
    """Straight down from above the ball on the table: the ball, then beside it the table, then the floor."""
    pose = make_pose(facing(0.0, -np.pi / 2), np.array([-0.25, 0.0, 2.0]))
    camera = Camera(1, 1, np.eye(3))
    rays = np.array([[[0.0, 0.0, 1.0]]], np.float32)
    ball = room.cast(rays, pose)[1]
    pose[:3, 3] = [-0.1, -0.25, 2.0]
    table = room.cast(rays, pose)[1]
    pose[:3, 3] = [1.4, 0.0, 2.0]
    floor = room.ray_trace(camera, pose, samples=1).depth
    np.testing.assert_allclose([ball.item(), table.item(), floor.item()], [2.0 - 1.03 - 0.23, 1.2, 2.0], atol=1e-5)


@pytest.mark.slow
def test_rooms_of_a_seed_are_the_same_and_of_another_are_not(room):
    again, other = Room(seed=0), Room(seed=1)
    np.testing.assert_array_equal(again.pictures[0][0], room.pictures[0][0])
    assert (other.pictures[0][0] != room.pictures[0][0]).any()


# The photos


@given(seed=st.integers(0, 10_000), time=st.floats(0, 1000))
def test_walk_keeps_clear_of_everything(room, seed, time):
    walk = Walk(np.random.default_rng(seed).uniform(0, 2 * np.pi, 4))
    pose = walk.pose(time)
    assert room.is_free(pose[None, :3, 3], MIN_CLEARANCE)[0]
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    # It holds the camera upright: image down points down in the room.
    assert pose[2, 1] < -0.8


@pytest.mark.slow
def test_no_photos(room, room_camera):
    assert simulate_photos(room, room_camera, count=0) == []


def test_photos_have_priors_in_free_space(room, room_camera, room_photos):
    stamps = [photo.stamp for photo in room_photos]
    assert stamps == sorted(set(stamps))
    for photo in room_photos:
        assert photo.image.shape == (room_camera.height, room_camera.width, 3)
        assert photo.image.dtype == np.uint8
        degrees = rotation_error_deg(photo.T_map_camera, photo.T_map_camera_prior)
        assert PRIOR_ROTATION_DEG[0] <= degrees <= PRIOR_ROTATION_DEG[1]
        metres = translation_error(photo.T_map_camera, photo.T_map_camera_prior)
        assert PRIOR_TRANSLATION[0] <= metres <= PRIOR_TRANSLATION[1]
        assert room.is_free(photo.T_map_camera_prior[None, :3, 3], MIN_CLEARANCE)[0]


@pytest.mark.slow
def test_photos_of_a_seed_are_the_same(room, room_camera, room_photos):
    (again,) = simulate_photos(room, room_camera, count=1, seed=0)
    np.testing.assert_array_equal(again.image, room_photos[0].image)
    np.testing.assert_array_equal(again.T_map_camera_prior, room_photos[0].T_map_camera_prior)


@pytest.fixture(scope="module")
def small_camera(room_camera):
    return room_camera.scaled(320, 240)


@pytest.fixture(scope="module")
def photographer(room, small_camera):
    return RoomCamera(room, small_camera)


def take_photo(photographer, pose_at, seed: int = 0) -> np.ndarray:
    return photographer.photo(pose_at, 0.0, np.random.default_rng(seed)).astype(np.float32) / 255


@pytest.mark.slow
def test_still_photo_is_what_the_tracer_sees_but_for_light_and_noise(room, small_camera, photographer, room_photos):
    pose = room_photos[0].T_map_camera
    middle = np.s_[70:170, 110:210]  # the corners are darker
    photo = take_photo(photographer, lambda time: pose)[middle]
    seen = room.ray_trace(small_camera, pose, samples=3).rgb[middle]
    gains = (photo * seen).sum((0, 1)) / (seen**2).sum((0, 1))
    assert psnr(photo, gains * seen) > 28


@pytest.mark.slow
def test_photos_differ_in_exposure_and_noise(photographer, room_photos):
    pose = room_photos[0].T_map_camera
    photos = [take_photo(photographer, lambda time: pose, seed) for seed in range(4)]
    means = [photo.mean() for photo in photos]
    assert max(means) / min(means) > 1.03
    noise = np.std(photos[0] - photos[1] * means[0] / means[1])
    assert 1 / 255 < noise < 10 / 255


def test_corners_of_photos_are_darker(room, small_camera, photographer, room_photos):
    pose = room_photos[0].T_map_camera
    ratio = take_photo(photographer, lambda time: pose) / np.maximum(
        room.ray_trace(small_camera, pose, samples=1).rgb, 0.1
    )
    assert np.median(ratio[:40, :40]) < 0.9 * np.median(ratio[100:140, 140:180])


def test_motion_blurs(photographer, room_photos):
    place = room_photos[0].T_map_camera[:3, 3]
    sharp = take_photo(photographer, lambda time: make_pose(facing(0.0, -0.2), place))
    blurred = take_photo(photographer, lambda time: make_pose(facing(3.0 * time, -0.2), place))
    # The camera turns about the vertical: what changes from left to right is lost.
    across = [np.abs(np.diff(photo.mean(axis=2), axis=1)).mean() for photo in (sharp, blurred)]
    assert across[1] < 0.8 * across[0]


# The map


@pytest.mark.slow
def test_map_looks_like_the_room(room, room_map, room_camera, room_photos):
    pinhole = Camera(room_camera.width, room_camera.height, room_camera.K)
    renderer = create_renderer(room_map)
    for photo in room_photos[::4]:
        trace, render = room.ray_trace(pinhole, photo.T_map_camera), renderer.render(pinhole, photo.T_map_camera)
        assert psnr(render.rgb, trace.rgb) > 21
        assert render.alpha.mean() > 0.99
        assert np.nanmedian(np.abs(render.depth - trace.depth)) < 0.006


def test_map_has_a_fit_number_of_gaussians_and_none_under_the_furniture(room, room_map):
    assert 150_000 < len(room_map) < 300_000
    np.testing.assert_allclose(np.linalg.norm(room_map.rotations, axis=1), 1, atol=1e-6)
    floor = room_map.means[np.abs(room_map.means[:, 2]) < 1e-6]
    assert len(floor) > 10_000
    for solid in room.solids[1:]:
        if isinstance(solid, Box) and solid.centre[2] == pytest.approx(solid.size[2] / 2):
            lifted = floor + np.array([0, 0, solid.centre[2]])  # the footprint is the box cut at half its height
            assert (solid.distance(lifted) > -0.02).all()


# The bag


def test_bag_holds_the_photos(tmp_path, room_camera, room_photos):
    write_bag(tmp_path / "bag", room_camera, room_photos)
    types = get_typestore(Stores.ROS2_JAZZY)
    with Reader(tmp_path / "bag") as bag:
        messages = [
            (connection.topic, types.deserialize_cdr(cdr, connection.msgtype)) for connection, _, cdr in bag.messages()
        ]
    order = ["/prior", "/camera/camera_info", "/camera/image_raw", "/ground_truth"]
    assert [topic for topic, _ in messages] == order * len(room_photos)
    for index, photo in enumerate(room_photos):
        prior, info, image, truth = (message for _, message in messages[4 * index : 4 * index + 4])
        for message in (prior, info, image, truth):
            stamp = message.header.stamp
            assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(photo.stamp, abs=1e-6)
        assert image.encoding == "rgb8"
        np.testing.assert_array_equal(image.data.reshape(image.height, image.width, 3), photo.image)
        np.testing.assert_array_equal(info.k.reshape(3, 3), room_camera.K)
        np.testing.assert_array_equal(info.d, room_camera.distortion)
        assert (info.width, info.height, info.distortion_model) == (640, 480, "plumb_bob")
        for message, pose in ((prior, photo.T_map_camera_prior), (truth, photo.T_map_camera)):
            p, q = message.pose.position, message.pose.orientation
            assert message.header.frame_id == "map"
            written = make_pose(matrix_from_quaternion(np.array([q.x, q.y, q.z, q.w])), np.array([p.x, p.y, p.z]))
            np.testing.assert_allclose(written, pose, atol=1e-12)


def test_bag_of_nothing_is_a_bag(tmp_path, room_camera):
    write_bag(tmp_path / "bag", room_camera, [])
    with Reader(tmp_path / "bag") as bag:
        assert bag.message_count == 0
        assert len(bag.connections) == 4
