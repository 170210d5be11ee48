"""The page of gsfeatloc view, without a browser: what is drawn where, what is clicked, and what is shown of texts."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from small_maps import one_gaussian, random_map
from websockets.datastructures import Headers

from gsfeatloc_ros.align.fit import UndeterminedError
from gsfeatloc_ros.align.level import level_by_points
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, matrix_from_quaternion, random_unit_vector, so3_exp, transform
from gsfeatloc_ros.localize.settings import MapSettings
from gsfeatloc_ros.maps.similarity import Similarity
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.replay.bag import Role
from gsfeatloc_ros.ros_io.parameter_file import read_parameter_file
from gsfeatloc_ros.simulate import simulate_photos
from gsfeatloc_ros.simulate.bag import CAMERA_INFO_TOPIC, IMAGE_TOPIC, PRIOR_TOPIC, write_bag
from gsfeatloc_ros.view.attempts import Attempt, Prior, read_replay
from gsfeatloc_ros.view.drawing import counts, round_down
from gsfeatloc_ros.view.picking import point_on_map
from gsfeatloc_ros.view.placing import Placing
from gsfeatloc_ros.view.prior_panel import base_facing
from gsfeatloc_ros.view.recorded import WIDTH, read_recording, small_photo
from gsfeatloc_ros.view.server import is_own_page
from gsfeatloc_ros.view.shapes import EDGES, base_box, ellipsoids, frustums, looking_along
from gsfeatloc_ros.view.splats import thinned_splats
from gsfeatloc_ros.view.store import Store
from gsfeatloc_ros.view.words import plain

VECTORS = arrays(np.float64, 3, elements=st.floats(-3, 3))
PLACED = Similarity(2.5, so3_exp(np.array([0.3, -0.2, 1.0])), np.array([1e6, -7.0, 3.0]))


def test_splats_lie_where_the_map_does():
    gaussian_map = random_map(50, 1, seed=3).placed(PLACED)
    splats = thinned_splats(gaussian_map, 50)
    # Where each is, by its centre: the order is another.
    centres = splats.centres.astype(np.float64) * splats.unit + splats.origin
    expected = PLACED.transform(gaussian_map.means.astype(np.float64))
    order, wanted = np.lexsort(centres.round(2).T), np.lexsort(expected.round(2).T)
    np.testing.assert_allclose(centres[order], expected[wanted], atol=1e-4)
    # The volume of a Gaussian does not depend on how it is turned.
    volumes = np.sqrt(np.linalg.det(splats.covariances.astype(np.float64))) * splats.unit**3
    np.testing.assert_allclose(volumes[order], (PLACED.scale**3 * gaussian_map.scales.prod(axis=1))[wanted], rtol=1e-2)


def test_a_splat_is_turned_as_its_gaussian():
    flat = one_gaussian([1.0, 2.0, 3.0], [0.5, 0.2, 0.01], opacity=0.8)
    half_turn = replace(flat, rotations=np.array([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]], np.float32))  # x to y
    splats = thinned_splats(half_turn, 10)
    expected = np.diag([0.2**2, 0.5**2, 0.01**2])
    np.testing.assert_allclose(splats.covariances[0] * splats.unit**2, expected, atol=1e-6)
    assert splats.opacities[0, 0] == pytest.approx(0.8)


def test_thinned_splats_cover_as_much():
    gaussian_map = random_map(400, 0, seed=1)
    few = thinned_splats(gaussian_map, 100)
    assert len(few.centres) == 100
    same = replace(gaussian_map, scales=np.full((400, 3), 0.1, np.float32))
    areas = [
        np.trace(s.covariances[0]) * s.unit**2 * len(s.centres) for s in map(thinned_splats, [same] * 2, [400, 100])
    ]
    assert areas[0] == pytest.approx(areas[1], rel=1e-3)


def test_cameras_show_their_image():
    assert frustums([], 1.0).shape == (0, 2, 3)
    pose = make_pose(so3_exp(np.array([0.1, 0.7, -0.4])), [1.0, 2.0, 3.0])
    lines = frustums([pose, pose], 0.5)
    assert len(lines) == 2 * EDGES
    inside = transform(np.linalg.inv(pose), lines.reshape(-1, 3)).reshape(lines.shape)
    # The first four go from the centre to the corners of a picture ahead, which is 4 to 3.
    np.testing.assert_allclose(inside[:4, 0], 0, atol=1e-12)
    size = np.ptp(inside[:4, 1], axis=0)
    np.testing.assert_allclose(inside[:4, 1, 2], 0.5)
    assert size[0] / size[1] == pytest.approx(4 / 3)


def test_a_base_lies_where_it_stands_and_points_ahead():
    pose = base_facing(np.array([1.0, 2.0, 0.1]), np.array([1.0, 5.0, 0.9]))
    lines = base_box(pose, 0.5)
    ground, ahead = lines[:4, 0], lines[np.argmax(lines[:, 0, 1])]
    np.testing.assert_allclose(ground.mean(axis=0), [1, 2, 0.1])
    np.testing.assert_allclose(np.ptp(ground, axis=0), [0.5, 0.5, 0], atol=1e-12)
    np.testing.assert_allclose(ahead, [[1, 2.5, 0.35], [1, 2, 0.35]])


@given(arrays(np.float64, (3, 3), elements=st.floats(-2, 2)))
def test_an_ellipsoid_is_that_of_its_covariance(root):
    covariance = root @ root.T
    axes, lengths = ellipsoids(covariance[None])
    np.testing.assert_allclose(axes[0] * lengths[0] ** 2 @ axes[0].T, covariance, atol=1e-9)
    assert np.linalg.det(axes[0]) == pytest.approx(1)


def test_no_covariances_are_no_ellipsoids():
    axes, lengths = ellipsoids(np.empty((0, 3, 3)))
    assert axes.shape == (0, 3, 3)
    assert lengths.shape == (0, 3)


@given(VECTORS, VECTORS.filter(lambda direction: np.linalg.norm(direction) > 1e-3))
def test_a_camera_that_looks_along_a_ray_sees_it_in_its_middle(origin, direction):
    pose = looking_along(origin, direction)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    ahead = transform(np.linalg.inv(pose), (origin + direction)[None])[0]
    np.testing.assert_allclose(ahead, [0, 0, np.linalg.norm(direction)], atol=1e-9)


def test_a_click_meets_the_surface_that_a_ray_meets(room, room_map):
    renderer = create_renderer(room_map, "cpu", 1)
    rng = np.random.default_rng(0)
    origin = np.array([0.0, 0.0, 1.5])
    errors = []
    for _ in range(20):
        direction = random_unit_vector(rng)
        point = point_on_map(renderer, origin, direction)
        narrow = Camera.centred(1, 1, 1000.0)
        depth = room.ray_trace(narrow, looking_along(origin, direction)).depth[0, 0]
        errors.append(np.linalg.norm(point - (origin + depth * direction)))
    assert np.median(errors) < 0.03
    assert point_on_map(create_renderer(one_gaussian([0, 0, 5], 0.1, 0.9), "cpu", 1), np.zeros(3), [0, 0, -1.0]) is None


@given(st.integers(0, 10_000))
def test_points_on_the_floor_say_where_it_is(seed):
    rng = np.random.default_rng(seed)
    S_robot_map = Similarity(1.0, so3_exp(3 * random_unit_vector(rng) * rng.uniform()), rng.normal(size=3))
    floor = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [2, 3, 0]])
    in_map = S_robot_map.inverse()
    found = level_by_points(in_map.transform(floor), in_map.transform(np.array([[0, 0, 1.7]]))[0], metres=True)
    np.testing.assert_allclose(found.S_robot_map.transform(in_map.transform(floor))[:, 2], 0, atol=1e-9)
    above = found.S_robot_map.transform(in_map.transform(np.array([[1.0, 1.0, 0.5]])))
    assert above[0, 2] == pytest.approx(0.5)


@pytest.mark.parametrize("points", [[[0, 0, 0], [1, 1, 1]], [[0, 0, 0], [1, 1, 1], [2, 2, 2.01]], [[1, 1, 1]] * 3])
def test_points_on_a_line_say_no_floor(points):
    with pytest.raises(UndeterminedError, match="on a line"):
        level_by_points(np.array(points, float), np.ones(3), metres=False)


def test_floor_and_scale_step_by_step_are_one_similarity(tmp_path):
    truth = Similarity(0.4, so3_exp(np.array([2.0, 0.3, 0.1])), np.array([0.0, 0.0, 1.0]))
    shown = MapSettings(path="/maps/room.ply", scale=3.0, translation=(1.0, 2.0, 3.0))
    in_shown = (truth @ shown.alignment().inverse()).inverse()
    placing = Placing(shown)
    corners, above = in_shown.transform(np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])), np.array([[1.0, 1, 2]])
    placing.set_floor(corners, in_shown.transform(above)[0], metres=False)
    placing.set_scale(corners[0], corners[1], 4.0)
    placing.write(tmp_path / "map.yaml")
    values = read_parameter_file(tmp_path / "map.yaml")
    assert values["map.scale"] == pytest.approx(truth.scale)
    written = Similarity(truth.scale, *_placed(values))
    # Of heading, x and y nothing was said.
    points = np.random.default_rng(0).normal(size=(9, 3))
    np.testing.assert_allclose(written.transform(points)[:, 2], truth.transform(points)[:, 2], atol=1e-6)
    assert "map.yaml" not in (tmp_path / "map.yaml").read_text()
    placing.reset()
    assert placing.settings() == replace(shown, rotation=placing.settings().rotation)


def _placed(values):
    return matrix_from_quaternion(values["map.rotation"]), values["map.translation"]


@pytest.mark.slow
def test_the_floor_of_the_room_is_found(room_map):
    tilted = Similarity(1.0, so3_exp(np.array([0.5, 0.2, 0.0])), np.array([0.0, 0.0, -2.0]))
    placing = Placing(MapSettings())
    placing.find_floor(room_map.placed(tilted), metres=True)
    found = placing.S_robot_shown @ tilted
    assert np.degrees(np.arccos(found.rotation[2, 2])) < 1
    assert found.translation[2] == pytest.approx(0, abs=0.05)
    assert placing.settings().aligned


def test_a_base_stands_upright_and_faces_what_is_said():
    pose = base_facing(np.array([1.0, 2.0, 0.1]), np.array([1.0, 5.0, 0.9]))
    np.testing.assert_allclose(pose[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 0.1])
    assert base_facing(np.zeros(3), np.array([0.0, 0.0, 1.0])) is None


class Tags(HTMLParser):
    """Notes whether there is any tag, and the text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text = [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        self.text += data


@given(st.text(max_size=60) | st.just("<img src=x onerror=alert(1)> ![x](http://e.org/x.png) [a](javascript:b)"))
def test_texts_from_elsewhere_are_no_html_and_no_markdown(text):
    shown = Tags(plain(text))
    assert not shown.tags
    # What Markdown means something by has a backslash before it.
    unescaped = shown.text.replace("\\\\", "")
    for mark in "[]()*_`!":
        assert unescaped.count(mark) == unescaped.count("\\" + mark)
    assert "\n" not in plain(text)


@pytest.mark.parametrize(
    ("headers", "only_here", "own"),
    [
        ({"Host": "127.0.0.1:8080"}, True, True),
        ({"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080"}, True, True),
        ({"Host": "localhost:8080", "Origin": "http://localhost:8080"}, True, True),
        ({"Host": "127.0.0.1:8080", "Origin": "https://evil.example"}, True, False),
        ({"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:9999"}, True, False),
        ({"Host": "127.0.0.1:8080", "Origin": "null"}, True, False),
        # A name that was made to mean this machine.
        ({"Host": "evil.example:8080", "Origin": "http://evil.example:8080"}, True, False),
        ({"Host": "robot.lan:8080", "Origin": "http://robot.lan:8080"}, False, True),
        ({"Host": "robot.lan:8080", "Origin": "http://evil.example"}, False, False),
        ({}, True, False),
    ],
)
def test_no_other_page_may_use_this_one(headers, only_here, own):
    assert is_own_page(Headers(headers), only_here) is own


def test_what_is_said_of_an_attempt_comes_together():
    store, pose = Store(), make_pose(np.eye(3), [1.0, 2.0, 3.0])
    assert store.attempts() == []
    prior = Prior(pose)
    store.add_prior(prior)
    store.add(Attempt(7, "", "", pose, np.eye(6)))
    store.add(Attempt(7, "localized", "so it is"))
    store.add(Attempt(7, "", "", candidates=np.array([pose, pose])))
    store.add(Attempt(8, "failed", "dark"))
    first, second = store.attempts()
    assert (first.status, first.reason) == ("localized", "so it is")
    assert first.pose is pose
    assert len(first.candidates) == 2
    assert second.pose is None
    assert store.prior(7) is prior
    assert counts(store.attempts()) == {"failed": 1, "localized": 1}
    before = store.changes
    for stamp in range(2000):
        store.add(Attempt(stamp, "localized", ""))
    assert store.changes != before
    assert len(store.attempts()) == 1000


def test_the_output_of_replay_is_read(tmp_path):
    names = "stamp,status,reason,x,y,z,qx,qy,qz,qw,var_x,var_y,var_z,var_rx,var_ry,var_rz"
    rows = [
        '1.5,localized,"a, b",1,2,3,0,0,0,1,1,1,1,1,1,1',
        "2.5,failed,dark,,,,,,,,,,,,,",
        ",refused,no stamp,,,,,,,,,,,,,",
    ]
    (tmp_path / "answers.csv").write_text("\n".join([names, *rows]))
    answered, failed = read_replay(tmp_path)
    assert (answered.stamp, answered.status, answered.reason) == (1_500_000_000, "localized", "a, b")
    np.testing.assert_allclose(answered.pose[:3, 3], [1, 2, 3])
    assert failed.pose is None
    (tmp_path / "answers.csv").write_text("stamp,x\n1,2\n")
    with pytest.raises(ValueError, match="as replay writes it"):
        read_replay(tmp_path)
    (tmp_path / "answers.csv").write_text("\n".join([names, "x,localized,,1,2,3,0,0,0,1,1,1,1,1,1,1"]))
    with pytest.raises(ValueError, match="line 2"):
        read_replay(tmp_path)


def test_photos_of_a_bag_are_kept_small_with_their_priors(room, tmp_path):
    camera = Camera(480, 360, np.array([[400.0, 0, 240], [0, 400, 180], [0, 0, 1]]), np.array([-0.2, 0, 0, 0]))
    photos = simulate_photos(room, camera, 2)
    write_bag(tmp_path / "bag", camera, photos)
    topics = {Role.IMAGE: [IMAGE_TOPIC], Role.CAMERA_INFO: [CAMERA_INFO_TOPIC], Role.PRIOR: [PRIOR_TOPIC]}
    wanted = round(photos[1].stamp * 1e9)
    recording = read_recording(tmp_path / "bag", topics, None, {wanted})
    (photo,) = recording.photos.values()
    assert photo.pixels().shape == (300, WIDTH, 3)
    assert not photo.camera.distorted
    np.testing.assert_allclose(recording.priors[wanted], photos[1].T_map_camera_prior, atol=1e-6)
    with pytest.raises(ValueError, match="camera_info"):
        small_photo(np.zeros((5, 5, 3), np.uint8), camera)


@given(st.floats(1e-6, 1e6))
def test_rounding_down_gives_one_two_or_five(value):
    rounded = round_down(value)
    assert rounded <= value * (1 + 1e-6)
    assert rounded * 2.5 > value * (1 - 1e-6)
    assert f"{rounded:e}"[0] in "125"
