"""Data sets of every kind: read into our conventions, and refused when they cannot be right."""

import json
import shutil
import sys

import cv2
import numpy as np
import PIL.Image
import pycolmap
import pytest
from picture_files import png
from room_datasets import angle_x, colmap_camera, save_image, write_colmap, write_nerf_synthetic

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, rotation_error_deg, translation_error
from gsfeatloc_ros.evaluate import colmap
from gsfeatloc_ros.evaluate.protocol import trajectory_radius
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.simulate import simulate_photos

FAR = np.eye(4)
FAR[2, 3] = 1e300

# nerfstudio


@pytest.fixture
def transforms():
    """transforms.json of two frames, 8x6 pixels: one at the origin as OpenGL sees it, one a step to the right."""
    step = np.eye(4)
    step[0, 3] = 1.0
    return {
        "fl_x": 10.0,
        "fl_y": 11.0,
        "cx": 4.0,
        "cy": 3.0,
        "w": 8,
        "h": 6,
        "frames": [
            {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()},
            {"file_path": "images/b.png", "transform_matrix": step.tolist()},
        ],
        "train_filenames": ["images/a.png"],
        "test_filenames": ["images/b.png"],
    }


def save_scene(folder, transforms, photo=None):
    """Write transforms.json, the test photo, RGB(A), and the name of a map."""
    save_image(folder / "images/b.png", np.full((6, 8, 3), 7, np.uint8) if photo is None else photo)
    (folder / "transforms.json").write_text(json.dumps(transforms), encoding="utf-8")
    (folder / "map.ply").touch()
    return folder


def test_scene_is_read_into_our_conventions(tmp_path, transforms):
    scene = load_scene(save_scene(tmp_path, transforms))
    # The middle of an image 8 wide is at 4 where the top-left pixel's centre is at 0.5, at 3.5 where it is at 0.
    np.testing.assert_array_equal(scene.camera.K, [[10, 0, 3.5], [0, 11, 2.5], [0, 0, 1]])
    # OpenGL looks along -z with y up; we look along z with y down.
    expected = [[1, 0, 0, 1], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
    np.testing.assert_array_equal(scene.photos[0].T_map_camera, expected)
    assert [photo.name for photo in scene.photos] == ["b.png"]
    assert scene.trajectory.shape == (2, 4, 4)
    assert trajectory_radius(scene) == pytest.approx(0.5)
    assert scene.background == (0.0, 0.0, 0.0)


def test_distortion_is_kept(tmp_path, transforms):
    scene = load_scene(save_scene(tmp_path, transforms | {"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}))
    np.testing.assert_array_equal(scene.camera.distortion[:4], [0.1, 0.2, 0.3, 0.4])


def test_photo_colours(tmp_path, transforms):
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    scene = load_scene(save_scene(tmp_path, transforms, pixels))
    np.testing.assert_array_equal(scene.read_photo(scene.photos[0]), pixels)


def test_photo_with_alpha_lies_on_white(tmp_path, transforms):
    pixels = np.zeros((6, 8, 4), np.uint8)
    pixels[0, 0] = [200, 100, 0, 255]
    pixels[0, 1] = [200, 100, 0, 51]
    scene = load_scene(save_scene(tmp_path, transforms, pixels))
    photo = scene.read_photo(scene.photos[0])
    assert scene.background == (1.0, 1.0, 1.0)
    assert photo[0, 0].tolist() == [200, 100, 0]
    assert photo[0, 1].tolist() == [244, 224, 204]  # a fifth of the colour, four fifths of white
    assert photo[5, 7].tolist() == [255, 255, 255]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fl_x": None}, "transforms.json"),
        ({"fl_x": 0.0}, "focal"),
        ({"w": 0}, "size"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model EQUIRECTANGULAR is not one of"),
        ({"is_fisheye": True, "camera_model": "OPENCV"}, "is_fisheye is true, but camera_model is OPENCV"),
        ({"k4": 0.01}, "k4 of a lens of camera_model OPENCV cannot be used: undistort"),
        ({"is_fisheye": True, "p1": 0.01}, "p1 of a lens of camera_model OPENCV_FISHEYE cannot be used"),
        ({"train_filenames": ["images/a.png", "images/b.png"], "test_filenames": None}, "transforms.json"),
        ({"test_filenames": []}, "test_filenames is empty"),
        ({"test_filenames": ["images/c.png"]}, "1 test photos have no frame, the first is images/c.png"),
        ({"test_filenames": ["images/a.png"]}, r"1 of 1 test photos are missing, the first is a\.png"),
        ({"frames": [{"file_path": "images/b.png", "transform_matrix": [1, 2]}]}, r"images/b\.png"),
        ({"frames": [{"file_path": "images/b.png", "transform_matrix": np.ones((4, 4)).tolist()}]}, "rigid"),
        ({"frames": [{"file_path": "images/b.png", "transform_matrix": np.diag([1, 1, -1, 1]).tolist()}]}, "rigid"),
        ({"frames": [{"file_path": "images/b.png", "transform_matrix": [[float("nan")] * 4] * 4}]}, "finite"),
        ({"frames": [{"file_path": "images/b.png"}]}, "transform_matrix"),
        ({"frames": [1]}, "is not as nerfstudio writes it"),
        (
            {"frames": [{"file_path": "images/b.png", "transform_matrix": FAR.tolist()}]},
            r"1e\+300 units from the origin",
        ),
    ],
)
def test_scene_that_cannot_be_used(tmp_path, transforms, change, message):
    with pytest.raises(ValueError, match=message):
        load_scene(save_scene(tmp_path, transforms | change))


@pytest.mark.parametrize("key", ["fl_x", "cy", "w", "frames"])
def test_missing_key_is_named(tmp_path, transforms, key):
    del transforms[key]
    with pytest.raises(ValueError, match=f"lacks the key '{key}'"):
        load_scene(save_scene(tmp_path, transforms))


@pytest.mark.parametrize("content", ["", "{", "[]", "3", '"text"'])
def test_transforms_that_are_not_an_object(tmp_path, content):
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(ValueError, match=r"transforms\.json"):
        load_scene(tmp_path)


@pytest.mark.parametrize("there", [False, True])
def test_folder_that_is_no_scene(tmp_path, there):
    folder = tmp_path if there else tmp_path / "nowhere"
    with pytest.raises(ValueError, match=r"holds none of transforms\.json, transforms_test\.json, sparse"):
        load_scene(folder)


@pytest.mark.parametrize(("width", "height"), [(4, 3), (16, 12), (3, 2)])  # the last is rounded
def test_cameras_are_of_the_size_of_the_photos(tmp_path, transforms, width, height):
    scene = load_scene(save_scene(tmp_path, transforms, np.zeros((height, width, 3), np.uint8)))
    assert scene.read_photo(scene.photos[0]).shape == (height, width, 3)
    assert scene.camera.K[0, 0] == pytest.approx(10 * width / 8)
    # Its middle stays where it is.
    assert scene.camera.K[0, 2] == pytest.approx((width - 1) / 2)


def test_photo_of_another_shape(tmp_path, transforms):
    scene = load_scene(save_scene(tmp_path, transforms, np.zeros((4, 4, 3), np.uint8)))
    with pytest.raises(ValueError, match=r"4x4.*8x6"):
        scene.read_photo(scene.photos[0])


def test_grey_photo(tmp_path, transforms):
    folder = save_scene(tmp_path, transforms)
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
    cv2.imwrite(str(folder / "images/b.png"), grey)
    scene = load_scene(folder)
    np.testing.assert_array_equal(scene.read_photo(scene.photos[0]), np.stack([grey] * 3, axis=2))


def test_intrinsics_of_a_frame_go_before_those_at_the_top(tmp_path, transforms):
    transforms["frames"][1] |= {"fl_x": 20.0, "cx": 3.0, "k1": 0.1}
    scene = load_scene(save_scene(tmp_path, transforms))
    np.testing.assert_array_equal(scene.camera.K, [[20, 0, 2.5], [0, 11, 2.5], [0, 0, 1]])
    assert scene.camera.distortion[0] == 0.1


def test_intrinsics_of_frames_alone(tmp_path, transforms):
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    own = {key: transforms.pop(key) for key in keys}
    transforms["frames"][1] |= own  # the frame of the test photo; others need none
    np.testing.assert_array_equal(load_scene(save_scene(tmp_path, transforms)).camera.K[0], [10, 0, 3.5])


@pytest.mark.parametrize("named", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}])
def test_a_fisheye_is_one(tmp_path, transforms, named):
    coefficients = {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}
    camera = load_scene(save_scene(tmp_path, transforms | named | coefficients)).camera
    assert camera.model == "equidistant"
    np.testing.assert_array_equal(camera.distortion, [0.1, 0.2, 0.3, 0.4])


def test_without_a_split_every_eighth_photo_is_for_testing(tmp_path, transforms):
    del transforms["test_filenames"], transforms["train_filenames"]
    frame = transforms["frames"][0]
    transforms["frames"] = [frame | {"file_path": f"images/{number:02}.png"} for number in reversed(range(17))]
    folder = save_scene(tmp_path, transforms)
    for number in (0, 8, 16):
        save_image(folder / f"images/{number:02}.png", np.zeros((6, 8, 3), np.uint8))
    assert [photo.name for photo in load_scene(folder).photos] == ["00.png", "08.png", "16.png"]


def test_without_test_photos_they_are_those_that_made_no_map(tmp_path, transforms):
    del transforms["test_filenames"]
    assert [photo.name for photo in load_scene(save_scene(tmp_path, transforms)).photos] == ["b.png"]


def test_photo_that_is_not_an_image(tmp_path, transforms):
    save_scene(tmp_path, transforms)
    (tmp_path / "images/b.png").write_bytes(b"not a picture")
    with pytest.raises(ValueError, match=r"b\.png: is no JPEG or PNG"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("content", "says"),
    [(png(30_000, 30_000, b""), "30000x30000, more than 50 megapixels"), (png(8, 6, bytes(10**6)), "holds more than")],
    ids=["pixels", "bytes"],
)
def test_photo_that_takes_more_than_a_cameras_is_not_decoded(tmp_path, transforms, content, says):
    """OpenCV's own reading took gigabytes for the first, and for a moment in the second."""
    save_scene(tmp_path, transforms)
    (tmp_path / "images/b.png").write_bytes(content)
    with pytest.raises(ValueError, match=rf"b\.png: .*{says}"):
        load_scene(tmp_path)


# Maps


def test_map_beside_the_photos_is_found(tmp_path, transforms):
    folder = save_scene(tmp_path, transforms)
    (folder / "map.ply").unlink()
    with pytest.raises(ValueError, match=r"holds no map \(map\.ply, point_cloud\.ply, .*--map"):
        load_scene(folder)
    assert load_scene(folder, tmp_path / "elsewhere.ply").map_path == tmp_path / "elsewhere.ply"
    # Each is preferred over those before; of iterations the last, by number.
    for name in (
        "point_cloud/iteration_30000/point_cloud.ply",
        "point_cloud/iteration_7000/point_cloud.ply",
        "point_cloud.ply",
        "map.ply",
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
        expected = name.replace("_7000", "_30000")
        assert load_scene(folder).map_path == folder.resolve() / expected


def test_photos_of_the_same_name_are_told_apart_by_folder(tmp_path, transforms):
    frame = transforms["frames"][0]
    transforms["frames"] = [frame | {"file_path": f"{side}/a.png"} for side in ("left", "right")]
    transforms["test_filenames"] = ["left/a.png", "right/a.png"]
    folder = save_scene(tmp_path, transforms)
    for side in ("left", "right"):
        save_image(folder / side / "a.png", np.zeros((6, 8, 3), np.uint8))
    assert [photo.name for photo in load_scene(folder).photos] == ["left/a.png", "right/a.png"]


# Photos of the simulated room, in every layout


@pytest.fixture(scope="module")
def small_camera(room_camera):
    return room_camera.scaled(320, 240)


@pytest.fixture(scope="module")
def small_photos(room, small_camera):
    return simulate_photos(room, small_camera, count=9, seed=3)


@pytest.fixture(scope="module")
def localizer(room_map):
    return Localizer(create_renderer(room_map), create_matcher("sift"))


def assert_localizes(localizer, scene, index, prior):
    """The photo and its pose are of the same place, camera and half pixel."""
    photo = scene.photos[index]
    estimate = localizer.localize(scene.read_photo(photo), photo.camera, prior)
    assert estimate.localized, estimate.reason
    assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera) < 0.4
    assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.03


def test_nerf_synthetic(tmp_path, room, room_map_file, small_camera, small_photos, localizer):
    camera = Camera(320, 240, np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]]))
    poses = [simulated.T_map_camera for simulated in small_photos]
    photo = np.full((240, 320, 4), 255, np.uint8)
    photo[..., :3] = np.rint(255 * room.ray_trace(camera, poses[7]).rgb)
    photo[:30, :40, 3] = 0
    splits = {"train": poses[:5], "val": poses[5:7], "test": poses[7:8]}
    folder = write_nerf_synthetic(tmp_path, angle_x(camera), splits, [photo])
    scene = load_scene(folder, room_map_file)
    np.testing.assert_allclose(scene.camera.K, camera.K, atol=1e-9)
    assert not scene.camera.distortion.any()
    np.testing.assert_allclose(scene.photos[0].T_map_camera, poses[7], atol=1e-9)
    np.testing.assert_allclose(scene.trajectory, poses[:8], atol=1e-9)
    assert [photo.name for photo in scene.photos] == ["r_0.png"]
    assert scene.map_path == room_map_file
    assert scene.background == (1.0, 1.0, 1.0)
    pixels = scene.read_photo(scene.photos[0])
    assert (pixels[:30, :40] == 255).all()
    np.testing.assert_array_equal(pixels[30:], photo[30:, :, :3])
    assert_localizes(localizer, scene, 0, small_photos[7].T_map_camera_prior)


def test_nerf_synthetic_without_other_splits(tmp_path):
    photos = [np.zeros((6, 8, 4), np.uint8)] * 2
    write_nerf_synthetic(tmp_path, 1.0, {"test": [np.eye(4), moved_right(2.0)]}, photos)
    scene = load_scene(tmp_path, "map.ply")
    assert trajectory_radius(scene) == pytest.approx(1.0)


def moved_right(distance):
    return make_pose(np.eye(3), np.array([distance, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": []}, r"transforms_test\.json: frames is empty"),
        ({"camera_angle_x": 0.0}, r"camera_angle_x 0 is not between"),
        ({"camera_angle_x": 3.2}, r"camera_angle_x 3\.2 is not between"),
        ({"camera_angle_x": None}, r"transforms_test\.json"),
        ({"frames": [{"file_path": "test/r_9", "transform_matrix": np.eye(4).tolist()}]}, r"r_9\.png: is missing"),
        ({"frames": [{"transform_matrix": np.eye(4).tolist()}]}, "lacks the key 'file_path'"),
        ({"frames": [{"file_path": "test/r_0", "transform_matrix": [[1.0]]}]}, "finite 4x4"),
    ],
)
def test_nerf_synthetic_that_cannot_be_used(tmp_path, change, message):
    write_nerf_synthetic(tmp_path, 1.0, {"test": [np.eye(4)]}, [np.zeros((6, 8, 4), np.uint8)])
    path = tmp_path / "transforms_test.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ValueError, match=message):
        load_scene(tmp_path, "map.ply")


@pytest.mark.parametrize("text", [False, True])
def test_colmap(tmp_path, room_map_file, small_camera, small_photos, localizer, text):
    model, parameters = colmap_camera(small_camera)
    # Written in another order than that of the names, which decides.
    images = [(f"walk/{9 - index}.png", 0, simulated.T_map_camera) for index, simulated in enumerate(small_photos)]
    write_colmap(tmp_path, [(model, 320, 240, parameters)], images, text)
    shutil.copy(room_map_file, tmp_path / "point_cloud.ply")
    tested = [small_photos[8], small_photos[0]]
    for name, simulated in zip(("1", "9"), tested, strict=True):
        save_image(tmp_path / f"images/walk/{name}.png", simulated.image)
    scene = load_scene(tmp_path)
    assert [photo.name for photo in scene.photos] == ["1.png", "9.png"]
    np.testing.assert_allclose(scene.camera.K, small_camera.K, atol=1e-6)
    np.testing.assert_allclose(scene.camera.distortion, small_camera.distortion[:4], atol=1e-6)
    for photo, simulated in zip(scene.photos, tested, strict=True):
        np.testing.assert_allclose(photo.T_map_camera, simulated.T_map_camera, atol=1e-6)
    np.testing.assert_allclose(scene.trajectory, [each.T_map_camera for each in small_photos[::-1]], atol=1e-6)
    for index, simulated in enumerate(tested):
        assert_localizes(localizer, scene, index, simulated.T_map_camera_prior)


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_PINHOLE", [300, 161, 118]),
        ("PINHOLE", [300, 310, 161, 118]),
        ("SIMPLE_RADIAL", [300, 161, 118, -0.12]),
        ("RADIAL", [300, 161, 118, -0.12, 0.03]),
        ("OPENCV", [300, 310, 161, 118, -0.12, 0.03, 0.002, -0.001]),
        ("FULL_OPENCV", [300, 310, 161, 118, -0.12, 0.03, 0.002, -0.001, 0.004, 0.02, 0.01, -0.003]),
        ("SIMPLE_RADIAL_FISHEYE", [200, 161, 118, -0.02]),
        ("RADIAL_FISHEYE", [200, 161, 118, -0.02, 0.004]),
        ("OPENCV_FISHEYE", [200, 210, 161, 118, -0.02, 0.004, -0.001, 0.0005]),
    ],
)
def test_colmap_cameras_see_what_colmap_says(tmp_path, model, parameters):
    write_colmap(tmp_path, [(model, 320, 240, parameters)], [("a.png", 0, np.eye(4))])
    save_image(tmp_path / "images/a.png", np.zeros((240, 320, 3), np.uint8))
    camera = load_scene(tmp_path, "map.ply").camera
    directions = np.random.default_rng(0).uniform([-0.5, -0.35], [0.5, 0.35], (200, 2))
    points = np.column_stack([directions, np.ones(200)])
    theirs = pycolmap.Camera(model=model, width=320, height=240, params=parameters)
    # COLMAP has the centre of the top-left pixel at (0.5, 0.5).
    pixels = theirs.img_from_cam(points) - 0.5
    np.testing.assert_allclose(camera.rays(camera.undistort(pixels)), points, atol=1e-6)


def test_colmap_without_a_folder_0(tmp_path):
    write_colmap(tmp_path, [("PINHOLE", 8, 6, [4, 4, 4, 3])], [("a.png", 0, np.eye(4))])
    for file in (tmp_path / "sparse/0").iterdir():
        file.rename(tmp_path / "sparse" / file.name)
    (tmp_path / "sparse/0").rmdir()
    save_image(tmp_path / "images/a.png", np.zeros((3, 4, 3), np.uint8))
    scene = load_scene(tmp_path, "map.ply")
    # The photo is half as large as its model's camera, whose middle is at 4 where the corner is at 0.
    np.testing.assert_allclose(scene.camera.K, [[2, 0, 1.5], [0, 2, 1], [0, 0, 1]], atol=1e-9)


def test_photos_smaller_than_their_models_camera(tmp_path):
    parameters = [1200, 1240, 641, 481, -0.12, 0.03, 0.002, -0.001]
    write_colmap(tmp_path, [("OPENCV", 1283, 963, parameters)], [("a.png", 0, np.eye(4))])
    save_image(tmp_path / "images/a.png", np.full((241, 321, 3), 9, np.uint8))
    scene = load_scene(tmp_path, "map.ply")
    assert scene.read_photo(scene.photos[0]).shape == (241, 321, 3)
    theirs = pycolmap.Camera(model="OPENCV", width=1283, height=963, params=parameters)
    theirs.rescale(321, 241)
    points = np.array([[0.1, -0.2, 1.0], [-0.3, 0.25, 1.0]])
    pixels = theirs.img_from_cam(points) - 0.5
    np.testing.assert_allclose(scene.camera.rays(scene.camera.undistort(pixels)), points, atol=1e-6)
    # One that was cut is no smaller one.
    save_image(tmp_path / "images/a.png", np.zeros((200, 321, 3), np.uint8))
    scene = load_scene(tmp_path, "map.ply")
    with pytest.raises(ValueError, match="is 321x200, its camera is 1283x963"):
        scene.read_photo(scene.photos[0])


@pytest.mark.parametrize(("width", "height"), [(8, 6), (6, 8)])
def test_a_photo_of_a_phone_is_turned_where_its_camera_is(tmp_path, width, height):
    """COLMAP's camera is that of the pixels as stored, other programs' that of the photo as EXIF turns it."""
    stored = np.full((6, 8, 3), 60, np.uint8)
    stored[:, :4] = 200
    exif = PIL.Image.Exif()
    exif[0x0112] = 6  # to be turned by 90 degrees, clockwise
    (tmp_path / "images").mkdir()
    PIL.Image.fromarray(stored).save(tmp_path / "images/a.jpg", exif=exif, quality=100)
    write_colmap(tmp_path, [("PINHOLE", width, height, [4, 4, 4, 3])], [("a.jpg", 0, np.eye(4))])
    scene = load_scene(tmp_path, "map.ply")
    expected = stored if width == 8 else np.rot90(stored, -1)
    assert np.abs(scene.read_photo(scene.photos[0]).astype(int) - expected).max() < 9


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(6, 8), (6, 8, 3)])
def test_photos_that_are_grey_or_of_16_bits(tmp_path, dtype, shape):
    white = np.iinfo(dtype).max
    save_image(tmp_path / "images/a.png", np.full(shape, white // 5, dtype))
    write_colmap(tmp_path, [("PINHOLE", 8, 6, [4, 4, 4, 3])], [("a.png", 0, np.eye(4))])
    scene = load_scene(tmp_path, "map.ply")
    assert (scene.read_photo(scene.photos[0]) == np.full((6, 8, 3), 51, np.uint8)).all()


def test_colmap_with_several_cameras(tmp_path):
    wide, narrow = ("PINHOLE", 8, 6, [4, 4, 4, 3]), ("PINHOLE", 6, 8, [9, 9, 3, 4])
    images = [(f"{index}.png", index // 8, moved_right(index)) for index in range(9)]
    write_colmap(tmp_path, [wide, narrow], images)
    save_image(tmp_path / "images/0.png", np.zeros((6, 8, 3), np.uint8))
    save_image(tmp_path / "images/8.png", np.ones((8, 6, 3), np.uint8))
    scene = load_scene(tmp_path, "map.ply")
    assert [photo.camera.K[0, 0] for photo in scene.photos] == [4, 9]
    assert scene.read_photo(scene.photos[1]).shape == (8, 6, 3)


def test_colmap_with_a_camera_that_is_not_known(tmp_path):
    write_colmap(tmp_path, [("FOV", 8, 6, [4, 4, 4, 3, 0.9])], [("a.png", 0, np.eye(4))])
    with pytest.raises(ValueError, match=r"camera model FOV is not one of SIMPLE_PINHOLE, .*undistort"):
        load_scene(tmp_path, "map.ply")


def test_colmap_without_images(tmp_path):
    write_colmap(tmp_path, [("PINHOLE", 8, 6, [4, 4, 4, 3])], [])
    with pytest.raises(ValueError, match="holds no registered image"):
        load_scene(tmp_path, "map.ply")


def test_colmap_with_a_missing_photo(tmp_path):
    write_colmap(tmp_path, [("PINHOLE", 8, 6, [4, 4, 4, 3])], [("a.png", 0, np.eye(4))])
    with pytest.raises(ValueError, match=r"1 of 1 test photos are missing, the first is a\.png"):
        load_scene(tmp_path, "map.ply")


@pytest.mark.parametrize("kind", ["empty", "garbage"])
def test_colmap_model_that_cannot_be_read(tmp_path, kind):
    folder = tmp_path / "sparse/0"
    folder.mkdir(parents=True)
    if kind == "garbage":
        for name in ("rigs", "cameras", "frames", "images", "points3D"):
            (folder / f"{name}.bin").write_bytes(b"xx")
    with pytest.raises(ValueError, match="sparse/0: is not a COLMAP model"):
        load_scene(tmp_path, "map.ply")


@pytest.mark.parametrize("name", ["cameras", "images", "rigs", "frames"])
@pytest.mark.parametrize("count", [2, 10**6, 2**63, 2**64 - 1])
def test_colmap_counts_that_lie_are_refused_before_pycolmap_sees_them(tmp_path, monkeypatch, name, count):
    """It would take the memory, or read on for hours."""
    write_colmap(tmp_path, [("PINHOLE", 8, 6, [4, 4, 4, 3])], [("a.png", 0, np.eye(4))])
    file = tmp_path / f"sparse/0/{name}.bin"
    file.write_bytes(count.to_bytes(8, "little") + file.read_bytes()[8:])
    monkeypatch.setattr(pycolmap, "Reconstruction", lambda path: pytest.fail("pycolmap sees it"))
    with pytest.raises(ValueError, match=rf"not a COLMAP model: {name}.bin (claims|is truncated)"):
        load_scene(tmp_path, "map.ply")


def test_colmap_points_are_not_read(tmp_path):
    """Neither those of the model nor those in the photos, of which there may be millions; here they are a lie."""
    images = [(f"{name}.png", 0, np.eye(4)) for name in "ab"]
    write_colmap(tmp_path, [("PINHOLE", 8, 6, [4, 4, 4, 3])], images)
    (tmp_path / "sparse/0/points3D.bin").write_bytes(b"\xff" * 100)
    file = tmp_path / "sparse/0/images.bin"
    content = file.read_bytes()
    end = content.index(b"a.png\0") + 6
    points = (3).to_bytes(8, "little") + 3 * 24 * b"\xff"
    file.write_bytes(content[:end] + points + content[end + 8 :])
    _, poses = colmap.load(tmp_path)
    np.testing.assert_allclose(poses, [np.eye(4)] * 2)
    file.write_bytes(content[:end] + (2**61).to_bytes(8, "little") + content[end + 8 :])
    with pytest.raises(ValueError, match="claims 2305843009213693952 entries"):
        colmap.load(tmp_path)


def test_colmap_without_pycolmap(tmp_path, monkeypatch):
    write_colmap(tmp_path, [("PINHOLE", 8, 6, [4, 4, 4, 3])], [("a.png", 0, np.eye(4))])
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(RuntimeError, match="pycolmap is needed for this and is not installed: pip install pycolmap"):
        load_scene(tmp_path, "map.ply")
