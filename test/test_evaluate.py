"""Scenes, priors, the published recipe, the measures and the command."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.estimate import Estimate, Status
from gsfeatloc_ros.evaluate.metrics import measure, summarize
from gsfeatloc_ros.evaluate.protocol import PriorError, make_priors, paper_prior_error, perturb, trajectory_radius
from gsfeatloc_ros.evaluate.published import PublishedLocalizer
from gsfeatloc_ros.evaluate.scene import load_scene
from gsfeatloc_ros.geometry import invert, make_pose, rotation_error_deg, so3_exp, so3_log, translation_error
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.match import Features, Matches
from gsfeatloc_ros.render import Render, create_renderer
from gsfeatloc_ros.tools.evaluate import main

# Scenes


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
    """Write transforms.json and the test photo, RGB(A)."""
    (folder / "images").mkdir()
    photo = np.full((6, 8, 3), 7, np.uint8) if photo is None else photo
    to_bgr = cv2.COLOR_RGBA2BGRA if photo.shape[2] == 4 else cv2.COLOR_RGB2BGR
    cv2.imwrite(str(folder / "images/b.png"), cv2.cvtColor(photo, to_bgr))
    (folder / "transforms.json").write_text(json.dumps(transforms), encoding="utf-8")
    return folder


def test_scene_is_read_into_our_conventions(tmp_path, transforms):
    scene = load_scene(save_scene(tmp_path, transforms))
    # The middle of an image 8 wide is at 4 where the top-left pixel's centre is at 0.5, at 3.5 where it is at 0.
    np.testing.assert_array_equal(scene.camera.K, [[10, 0, 3.5], [0, 11, 2.5], [0, 0, 1]])
    # OpenGL looks along -z with y up; we look along z with y down.
    expected = [[1, 0, 0, 1], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
    np.testing.assert_array_equal(scene.photos[0].T_map_camera, expected)
    assert [photo.path.name for photo in scene.photos] == ["b.png"]
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
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({"test_filenames": []}, "test_filenames is empty"),
        ({"test_filenames": ["images/c.png"]}, "1 test photos have no frame, the first is images/c.png"),
        ({"test_filenames": ["images/a.png"]}, r"1 of 1 test photos are missing, the first is a\.png"),
        ({"frames": [{"file_path": "images/b.png", "transform_matrix": [1, 2]}]}, r"images/b\.png"),
        ({"frames": [{"file_path": "images/b.png", "transform_matrix": np.ones((4, 4)).tolist()}]}, "rigid"),
        ({"frames": [{"file_path": "images/b.png", "transform_matrix": np.diag([1, 1, -1, 1]).tolist()}]}, "rigid"),
        ({"frames": [{"file_path": "images/b.png", "transform_matrix": [[float("nan")] * 4] * 4}]}, "finite"),
        ({"frames": [{"file_path": "images/b.png"}]}, "transform_matrix"),
    ],
)
def test_scene_that_cannot_be_used(tmp_path, transforms, change, message):
    with pytest.raises(ValueError, match=message):
        load_scene(save_scene(tmp_path, transforms | change))


@pytest.mark.parametrize("key", ["fl_x", "cy", "w", "frames", "test_filenames"])
def test_missing_key_is_named(tmp_path, transforms, key):
    del transforms[key]
    with pytest.raises(ValueError, match=f"lacks the key '{key}'"):
        load_scene(save_scene(tmp_path, transforms))


@pytest.mark.parametrize("content", ["", "{", "[]", "3", '"text"'])
def test_transforms_that_are_not_an_object(tmp_path, content):
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(ValueError, match=r"transforms\.json"):
        load_scene(tmp_path)


def test_no_transforms(tmp_path):
    with pytest.raises(ValueError, match=r"transforms\.json: cannot be read: No such file"):
        load_scene(tmp_path)


def test_photo_of_another_size(tmp_path, transforms):
    scene = load_scene(save_scene(tmp_path, transforms, np.zeros((3, 4, 3), np.uint8)))
    with pytest.raises(ValueError, match=r"4x3.*8x6"):
        scene.read_photo(scene.photos[0])


def test_photo_that_is_not_an_image(tmp_path, transforms):
    save_scene(tmp_path, transforms)
    (tmp_path / "images/b.png").write_bytes(b"not a picture")
    with pytest.raises(ValueError, match=r"b\.png: is not an image"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("name", "photos", "frames", "background"),
    [("bonsai", 37, 292, (0.0, 0.0, 0.0)), ("lego", 50, 150, (1.0, 1.0, 1.0))],
)
def test_real_scenes(shared, name, photos, frames, background):
    scene = load_scene(shared / "scenes" / name)
    assert len(scene.photos) == photos
    assert len(scene.trajectory) == frames
    assert scene.background == background
    for photo in scene.photos:
        assert scene.read_photo(photo).shape == (scene.camera.height, scene.camera.width, 3)


@pytest.mark.parametrize("name", ["bonsai", "lego"])
def test_photos_and_renders_lie_on_each_other_to_the_half_pixel(shared, name):
    scene = load_scene(shared / "scenes" / name)
    renderer = create_renderer(load_map(scene.map_path), background=scene.background)
    width, height = scene.camera.width // 2, scene.camera.height // 2
    photos = [(p, cv2.resize(scene.read_photo(p), (width, height), interpolation=cv2.INTER_AREA)) for p in scene.photos]

    def psnr(shift):
        K = scene.camera.K.copy()
        K[:2, 2] += shift
        camera = replace(scene.camera, K=K).scaled(width, height)
        return np.mean([cv2.PSNR(image, renderer.render(camera, p.T_map_camera).image()) for p, image in photos[:6]])

    right = psnr([0, 0])
    assert right > 25
    for shift in ([0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]):
        assert right > psnr(shift)


# Priors


@pytest.mark.parametrize(("name", "degrees", "radii"), [("bonsai", 14.3, 0.263), ("lego", 12.1, 0.218)])
def test_prior_errors_are_the_published_ones(shared, name, degrees, radii):
    scene = load_scene(shared / "scenes" / name)
    error = paper_prior_error(scene, sigma=1.0)
    assert np.degrees(error.rotation) == pytest.approx(degrees, abs=0.05)
    assert error.translation / trajectory_radius(scene) == pytest.approx(radii, abs=0.0005)
    assert paper_prior_error(scene, sigma=0.5) == PriorError(error.rotation / 2, error.translation / 2)


def test_radius_of_bonsai(shared):
    assert trajectory_radius(load_scene(shared / "scenes/bonsai")) == pytest.approx(3.74, abs=0.005)


@given(seed=st.integers(0, 2**32 - 1))
def test_prior_is_moved_then_turned_in_the_camera_frame(seed):
    T_true = make_pose(so3_exp(np.array([0.3, -1.2, 0.8])), np.array([5.0, -3.0, 2.0]))
    prior = perturb(T_true, PriorError(0.25, 0.9), np.random.default_rng(seed))
    offset = invert(T_true) @ prior
    # The offset in the camera's frame does not depend on where the camera is.
    at_origin = perturb(np.eye(4), PriorError(0.25, 0.9), np.random.default_rng(seed))
    np.testing.assert_allclose(offset, at_origin, atol=1e-9)
    # Translation first: turning afterwards does not move the camera.
    unturned = perturb(T_true, PriorError(0.0, 0.9), np.random.default_rng(seed))
    np.testing.assert_allclose(prior[:3, 3], unturned[:3, 3], atol=1e-9)
    np.testing.assert_allclose(unturned[:3, :3], T_true[:3, :3], atol=1e-9)


def test_prior_errors_have_the_standard_deviations_asked_for():
    rng = np.random.default_rng(0)
    offsets = [perturb(np.eye(4), PriorError(0.25, 0.9), rng) for _ in range(4000)]
    turns = np.array([so3_log(offset[:3, :3]) for offset in offsets])
    moves = np.array([offset[:3, 3] for offset in offsets])
    for vectors, sigma in ((turns, 0.25), (moves, 0.9)):
        lengths = np.linalg.norm(vectors, axis=1)
        assert np.sqrt(np.mean(lengths**2)) == pytest.approx(sigma, rel=0.05)
        # |N(0, sigma^2)| has its median at 0.6745 sigma.
        assert np.median(lengths) == pytest.approx(0.6745 * sigma, rel=0.06)
        np.testing.assert_allclose(vectors.mean(axis=0), 0, atol=0.03)
        np.testing.assert_allclose(vectors.T @ vectors / len(vectors), np.eye(3) * sigma**2 / 3, atol=0.1 * sigma**2)


def test_no_error_gives_the_truth():
    T_true = make_pose(so3_exp(np.array([0.3, -1.2, 0.8])), np.array([5.0, -3.0, 2.0]))
    np.testing.assert_allclose(perturb(T_true, PriorError(0.0, 0.0), np.random.default_rng(0)), T_true, atol=1e-12)


def test_priors_depend_on_the_seed_and_the_photo_alone(tmp_path, transforms):
    frame = transforms["frames"][1]
    transforms["frames"] = [frame | {"file_path": f"images/{name}.png"} for name in "bcd"]
    transforms["test_filenames"] = ["images/b.png"] * 3
    scene = load_scene(save_scene(tmp_path, transforms))
    priors = make_priors(scene, PriorError(0.2, 0.5), seed=3)
    fewer = make_priors(replace(scene, photos=scene.photos[:2]), PriorError(0.2, 0.5), seed=3)
    np.testing.assert_array_equal(priors[:2], fewer)
    assert not np.allclose(priors[0], priors[1])
    assert not np.allclose(priors[0], make_priors(scene, PriorError(0.2, 0.5), seed=4)[0])


# The published recipe


class GivenMatches:
    """Matches known beforehand."""

    def __init__(self, a, b):
        self._matches = Matches(np.asarray(a, float), np.asarray(b, float), np.ones(len(a)))

    def features(self, image):
        return Features(np.empty((0, 2)), np.empty((0, 1)), np.empty(0))

    def match(self, a, b):
        return self._matches


class GivenDepth:
    """A render of known depth."""

    def __init__(self, depth):
        shape = depth.shape
        depth = depth.astype(np.float32)
        self._render = Render(
            rgb=np.zeros((*shape, 3), np.float32),
            depth=depth,
            median_depth=depth,
            depth_std=np.zeros(shape, np.float32),
            alpha=np.ones(shape, np.float32),
        )

    def render(self, camera, T_map_camera):
        return self._render


CAMERA = Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))
PRIOR = make_pose(so3_exp(np.array([0.3, -1.2, 0.8])), np.array([5.0, -3.0, 2.0]))


def shifted_pixels(rng, count=200):
    """Photo pixels, render pixels and depth of a camera one unit to the right of the prior.

    The depth of each pixel by itself is such that it moves by a whole number of pixels.
    """
    shifts = rng.integers(20, 60, (240, 320))
    b = np.column_stack([rng.integers(60, 320, count), rng.integers(0, 240, count)])
    a = b - np.column_stack([shifts[b[:, 1], b[:, 0]], np.zeros(count, int)])
    return a, b, 300.0 / shifts


def test_published_recipe_cuts_keypoints_to_whole_pixels():
    rng = np.random.default_rng(0)
    a, b, depth = shifted_pixels(rng)
    fractions = rng.uniform(0, 0.99, (2, len(a), 2))
    localizer = PublishedLocalizer(GivenDepth(depth), GivenMatches(a + fractions[0], b + fractions[1]))
    estimate = localizer.localize(np.zeros((240, 320, 3), np.uint8), CAMERA, PRIOR)
    expected = PRIOR @ make_pose(np.eye(3), np.array([1.0, 0, 0]))
    assert estimate.localized
    assert rotation_error_deg(estimate.T_map_camera, expected) < 1e-3
    assert translation_error(estimate.T_map_camera, expected) < 1e-4
    assert estimate.inliers == estimate.matches == len(a)


@pytest.mark.parametrize("count", [0, 3])
def test_published_recipe_with_too_few_matches_has_no_pose(count):
    a, b, depth = shifted_pixels(np.random.default_rng(0), count)
    localizer = PublishedLocalizer(GivenDepth(depth), GivenMatches(a.reshape(-1, 2), b.reshape(-1, 2)))
    estimate = localizer.localize(np.zeros((240, 320, 3), np.uint8), CAMERA, PRIOR)
    assert estimate.status is Status.FAILED
    assert estimate.T_map_camera is None
    assert f"{count} matches" in estimate.reason


def test_published_recipe_without_depth_has_no_pose():
    a, b, depth = shifted_pixels(np.random.default_rng(0))
    localizer = PublishedLocalizer(GivenDepth(np.full_like(depth, np.nan)), GivenMatches(a, b))
    estimate = localizer.localize(np.zeros((240, 320, 3), np.uint8), CAMERA, PRIOR)
    assert not estimate.localized
    assert estimate.matches == len(a)


def test_published_recipe_with_matches_of_nothing_has_no_pose():
    rng = np.random.default_rng(0)
    _, b, depth = shifted_pixels(rng, 30)
    localizer = PublishedLocalizer(GivenDepth(depth), GivenMatches(rng.uniform(0, 240, (30, 2)), b))
    estimate = localizer.localize(np.zeros((240, 320, 3), np.uint8), CAMERA, PRIOR)
    assert not estimate.localized or estimate.inliers < 10


# Measures


def moved(degrees, distance):
    return make_pose(so3_exp(np.radians([0.0, degrees, 0.0])), np.array([0.0, 0.0, distance]))


def answer(degrees, distance):
    return Estimate(Status.LOCALIZED, "found", moved(degrees, distance), matches=30, inliers=20, passes=2)


FAILED = Estimate(Status.FAILED, "3 matches", matches=3)


def result(estimate, prior=None, prior_is_answer=False, milliseconds=10.0):
    """Measured against a camera at the origin, in a trajectory of radius 2."""
    prior = moved(20.0, 1.0) if prior is None else prior
    return measure("a.png", estimate, np.eye(4), prior, 2.0, milliseconds, prior_is_answer)


def test_errors_of_an_answer():
    r = result(answer(3.0, 0.08))
    assert (r.rotation_error_deg, r.translation_error) == pytest.approx((3.0, 0.04))
    assert (r.prior_rotation_error_deg, r.prior_translation_error) == pytest.approx((20.0, 0.5))
    assert r.answered
    assert r.success


@pytest.mark.parametrize(
    ("degrees", "distance", "success"), [(4.9, 0.099, True), (5.1, 0.0, False), (0.0, 0.101, False)]
)
def test_success_takes_both_limits(degrees, distance, success):
    assert result(answer(degrees, distance)).success is success


def test_no_answer_has_the_errors_of_its_prior_and_is_no_success():
    r = result(FAILED, prior=moved(1.0, 0.02))
    assert (r.rotation_error_deg, r.translation_error) == pytest.approx((1.0, 0.01))
    assert not r.answered
    assert not r.success


def test_the_publication_answers_with_the_prior():
    r = result(FAILED, prior=moved(1.0, 0.02), prior_is_answer=True)
    assert r.success
    assert not r.answered
    assert not result(FAILED, prior=moved(20.0, 0.02), prior_is_answer=True).success


def test_summary():
    results = [
        result(answer(1.0, 0.02), milliseconds=10),
        result(answer(2.0, 0.04), milliseconds=20),
        result(answer(90.0, 0.06), milliseconds=30),
        result(FAILED, milliseconds=40),
    ]
    summary = summarize(results)
    assert summary["queries"] == 4
    assert summary["success_rate"] == 0.5
    assert summary["answered"] == 3
    assert summary["wrong_answers"] == 1
    assert summary["rotation_error_deg"] == pytest.approx({"mean": (1 + 2 + 90 + 20) / 4, "median": 11.0})
    assert summary["translation_error"] == pytest.approx({"mean": (0.01 + 0.02 + 0.03 + 0.5) / 4, "median": 0.025})
    assert summary["milliseconds"] == pytest.approx({"median": 25.0, "p95": 38.5})
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


# The command


@pytest.mark.parametrize("method", ["default", "published"])
def test_command_writes_its_report(shared, tmp_path, capsys, method):
    path = tmp_path / "report.json"
    scene = str(shared / "scenes/bonsai")
    assert (
        main([scene, "--method", method, "--matcher", "sift", "--limit", "2", "--sigma", "0.3", "--json", str(path)])
        == 0
    )
    report = json.loads(path.read_text())
    assert list(report) == [
        "scene",
        "protocol",
        "method",
        "matcher",
        "sigma",
        "seed",
        "queries",
        "success_rate",
        "rotation_error_deg",
        "translation_error",
        "answered",
        "wrong_answers",
        "milliseconds",
        "per_query",
    ]
    assert (report["scene"], report["protocol"], report["method"]) == ("bonsai", "paper", method)
    assert (report["matcher"], report["sigma"], report["seed"], report["queries"]) == ("sift", 0.3, 0, 2)
    assert report["success_rate"] == 1.0
    assert report["rotation_error_deg"]["median"] < 1.0
    assert report["milliseconds"]["median"] > 0
    printed = capsys.readouterr().out
    assert "DSCF5565.jpg" in printed
    assert "100.0 % of 2" in printed


def test_command_gives_the_same_answer_to_the_same_seed(shared, tmp_path):
    reports = []
    for number, limit in enumerate(("1", "2")):
        path = tmp_path / f"{number}.json"
        scene = str(shared / "scenes/lego")
        main(
            [scene, "--method", "published", "--matcher", "sift", "--seed", "5", "--limit", limit, "--json", str(path)]
        )
        reports.append(json.loads(path.read_text())["per_query"][0])
        del reports[-1]["milliseconds"]
    assert reports[0] == reports[1]


def test_command_on_a_folder_without_a_scene(tmp_path, capsys):
    assert main([str(tmp_path)]) == 1
    assert "transforms.json" in capsys.readouterr().err


def test_command_on_a_scene_without_a_map(tmp_path, transforms, capsys):
    assert main([str(save_scene(tmp_path, transforms))]) == 1
    assert "map.ply" in capsys.readouterr().err


@pytest.mark.parametrize(
    "wrong",
    [["--sigma", "-1"], ["--sigma", "nan"], ["--limit", "x"], ["--max-width", "0"], ["--json", "/nowhere/a.json"]],
)
def test_command_refuses_wrong_options_before_it_starts(tmp_path, wrong, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path), *wrong])
    assert wrong[0] in capsys.readouterr().err
