"""Priors, the published recipe and the measures."""

import inspect
import json
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import (
    invert,
    make_pose,
    quaternion_from_matrix,
    random_unit_vector,
    rotation_error_deg,
    so3_exp,
    so3_log,
    translation_error,
)
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.common.stage_clock import Interrupted
from gsfeatloc_ros.evaluate.ablation import ABLATIONS, FeatureTracker, WholePixelTracker, ablated_localizer
from gsfeatloc_ros.evaluate.dataset import PosedPhoto, Scene
from gsfeatloc_ros.evaluate.metrics import (
    Cost,
    QueryResult,
    Scoring,
    best_of,
    by_step,
    chi_square_cdf,
    measure,
    normalised_error,
    summarize,
)
from gsfeatloc_ros.evaluate.priors_file import read_priors
from gsfeatloc_ros.evaluate.protocol import (
    PROTOCOLS,
    PhotoPrior,
    PriorError,
    make_priors,
    paper_bounds,
    paper_prior_error,
    perturb,
    trajectory_radius,
)
from gsfeatloc_ros.evaluate.published import PublishedLocalizer
from gsfeatloc_ros.localize.estimate import Estimate, Status
from gsfeatloc_ros.localize.evidence import Evidence, Limits
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.protection import protection_level
from gsfeatloc_ros.localize.query import Components
from gsfeatloc_ros.match import Features, Matches, create_matcher, create_tracker
from gsfeatloc_ros.render import Render, create_renderer

CAMERA = Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))
PRIOR = make_pose(so3_exp(np.array([0.3, -1.2, 0.8])), np.array([5.0, -3.0, 2.0]))


@pytest.fixture
def scene():
    """Three photos on a circle of radius 2 that looks about, and a fourth pose on it."""
    angles = [0.0, 1.0, 2.0, 3.0]
    poses = [make_pose(so3_exp(np.array([0.2, a, 0.1 * a])), 2 * np.array([np.cos(a), 0, np.sin(a)])) for a in angles]
    photos = tuple(PosedPhoto(f"{i}.5.png", Path(f"{i}.5.png"), CAMERA, pose) for i, pose in enumerate(poses[:3]))
    return Scene("circle", Path("map.ply"), photos, np.array(poses), (0.0, 0.0, 0.0))


# Priors


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


def test_priors_depend_on_the_seed_and_the_photo_alone(scene):
    same = replace(scene, photos=scene.photos[:1] * 3)
    priors = make_priors(same, PriorError(0.2, 0.5), seed=3)
    fewer = make_priors(replace(same, photos=same.photos[:2]), PriorError(0.2, 0.5), seed=3)
    np.testing.assert_array_equal(priors[:2], fewer)
    assert not np.allclose(priors[0], priors[1])
    assert not np.allclose(priors[0], make_priors(same, PriorError(0.2, 0.5), seed=4)[0])


def test_paper_gives_each_photo_one_prior(scene):
    priors = PROTOCOLS["paper"](scene, 1.0, 3)
    assert [(prior.photo, prior.step) for prior in priors] == [(0, 0), (1, 0), (2, 0)]
    np.testing.assert_array_equal(
        [prior.T_map_camera for prior in priors], make_priors(scene, paper_prior_error(scene, 1.0), 3)
    )


def offsets(scene, priors):
    """Rotation vectors in degrees and translations of priors in the frames of the true cameras."""
    moved = [invert(scene.photos[prior.photo].T_map_camera) @ prior.T_map_camera for prior in priors]
    return np.degrees([so3_log(offset[:3, :3]) for offset in moved]), np.array([offset[:3, 3] for offset in moved])


@pytest.mark.parametrize(
    ("protocol", "repetitions", "degrees", "radii"),
    [("chen", 5, (10, 40), (0, 0.2)), ("near-miss", 1, (5, 20), (0.1, 0.5))],
)
def test_uniform_protocols_draw_priors_in_their_ranges(scene, protocol, repetitions, degrees, radii):
    priors = PROTOCOLS[protocol](scene, 1.0, 0)
    assert [(prior.photo, prior.step) for prior in priors] == [(i, k) for i in range(3) for k in range(repetitions)]
    many = replace(scene, photos=scene.photos[:1] * (2000 // repetitions))
    turns, moves = offsets(many, PROTOCOLS[protocol](many, 1.0, 0))
    radius = trajectory_radius(scene)
    for vectors, (low, high) in ((turns, degrees), (moves, np.multiply(radii, radius))):
        lengths = np.linalg.norm(vectors, axis=1)
        assert low <= lengths.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < lengths.max() <= high
        assert lengths.mean() == pytest.approx((low + high) / 2, rel=0.04)
        np.testing.assert_allclose((vectors / lengths[:, None]).mean(axis=0), 0, atol=0.04)
    half = offsets(many, PROTOCOLS[protocol](many, 0.5, 0))
    np.testing.assert_allclose(half, np.array([turns, moves]) / 2, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["paper", "chen", "near-miss"])
def test_covariance_of_a_prior_is_that_of_the_errors(scene, protocol):
    many = replace(scene, photos=scene.photos[1:2] * 2000)
    priors = PROTOCOLS[protocol](many, 1.0, 0)
    true = scene.photos[1].T_map_camera
    errors = [
        np.concatenate([prior.T_map_camera[:3, 3] - true[:3, 3], so3_log(prior.T_map_camera[:3, :3] @ true[:3, :3].T)])
        for prior in priors
    ]
    scale = np.sqrt(np.diag(priors[0].covariance))
    correlation = np.cov(np.transpose(errors)) / np.outer(scale, scale)
    np.testing.assert_allclose(correlation, np.eye(6), atol=0.12)


@pytest.mark.parametrize("protocol", ["sweep-rotation", "sweep-translation"])
def test_sweeps_go_to_the_bound_in_ten_steps(scene, protocol):
    priors = PROTOCOLS[protocol](scene, 2.0, 0)
    assert [(prior.photo, prior.step) for prior in priors] == [(i, k) for i in range(3) for k in range(11)]
    turns, moves = offsets(scene, priors)
    rotation, translation = paper_bounds(scene)
    steps = np.tile(np.linspace(0, 2, 11), 3)[:, None]
    if protocol == "sweep-rotation":
        # A camera that is panned to the right turns about its y axis, which points down.
        np.testing.assert_allclose(turns, steps * np.degrees([0, rotation, 0]), atol=1e-6)
        np.testing.assert_allclose(moves, 0, atol=1e-12)
    else:
        np.testing.assert_allclose(moves, steps * [translation, 0, 0], atol=1e-9)
        np.testing.assert_allclose(turns, 0, atol=1e-6)


def test_a_planar_robot_knows_height_and_tilt_alone(scene):
    many = replace(scene, photos=scene.photos * 400)
    priors = PROTOCOLS["planar"](many, 2.0, 0)
    known = np.sqrt(priors[0].covariance.diagonal())[[2, 3, 4]]
    true = np.array([many.photos[prior.photo].T_map_camera for prior in priors])
    poses = np.array([prior.T_map_camera for prior in priors])
    assert np.std(poses[:, 2, 3] - true[:, 2, 3]) == pytest.approx(known[0], rel=0.1)
    # Where up is in the camera does not depend on the turn about z.
    tilt = np.einsum("ij,ikj->ik", poses[:, 2, :3], true[:, :3, :3])
    np.testing.assert_allclose(np.std(tilt, axis=0)[:2], known[1:], rtol=0.1)
    turns = poses[:, :3, :3] @ true[:, :3, :3].swapaxes(1, 2)
    angles = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
    np.testing.assert_allclose(np.histogram(angles, bins=4, range=(-np.pi, np.pi))[0], len(priors) / 4, rtol=0.2)
    assert {*map(tuple, poses[:, :2, 3])} == {tuple(photo.T_map_camera[:2, 3]) for photo in scene.photos}
    assert (priors[0].covariance.diagonal()[[0, 1, 5]] > 1e5).all()


@given(seed=st.integers(0, 2**32 - 1), sigma=st.floats(0, 3))
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_protocols_give_poses(scene_of_one, protocol, seed, sigma):
    for prior in PROTOCOLS[protocol](scene_of_one, sigma, seed):
        rotation = prior.T_map_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        np.testing.assert_array_equal(prior.T_map_camera[3], [0, 0, 0, 1])


@pytest.fixture(scope="module")
def scene_of_one():
    photos = (PosedPhoto("a.png", Path("a.png"), CAMERA, PRIOR),)
    return Scene("one", Path("map.ply"), photos, np.array([PRIOR, np.eye(4)]), (0.0, 0.0, 0.0))


# Priors from a file


def fields_of(pose):
    """A pose as TUM and CSV files have it."""
    return [f"{value:.17g}" for value in (*pose[:3, 3], *quaternion_from_matrix(pose[:3, :3]))]


def random_poses(count):
    rng = np.random.default_rng(0)
    return [make_pose(so3_exp(rng.uniform(0, 3) * random_unit_vector(rng)), rng.normal(size=3)) for _ in range(count)]


# The photos of the scene are 0.5.png, 1.5.png and 2.5.png: a stamp and a suffix, as TUM's are.
@pytest.mark.parametrize("names", [["2.5", "0.5", "9.5", "0.5"], ["2.5.png", "0.5.png", "9.5.png", "0.5.png"]])
@pytest.mark.parametrize("kind", ["txt", "csv"])
def test_priors_from_a_file(tmp_path, scene, names, kind):
    poses = random_poses(4)
    path = tmp_path / f"priors.{kind}"
    if kind == "txt":
        lines = ["# stamp tx ty tz qx qy qz qw", ""]
        lines += [" ".join([name, *fields_of(pose)]) for name, pose in zip(names, poses, strict=True)]
    else:
        lines = ["qw, name, tx, ty, tz, qx, qy, qz, inliers"]
        for name, pose in zip(names, poses, strict=True):
            *others, qw = fields_of(pose)
            lines.append(", ".join([qw, name, *others, "12"]))
    path.write_text("\n".join(lines))
    priors = read_priors(path, scene)
    assert [(prior.photo, prior.step) for prior in priors] == [(0, 0), (0, 1), (2, 0)]
    np.testing.assert_allclose([p.T_map_camera for p in priors], [poses[1], poses[3], poses[0]], atol=1e-12)
    assert priors[0].covariance is None


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.txt", "", "no line is of a photo of circle; they are named like 0.5.png"),
        ("a.txt", "7.5 0 0 0 0 0 0 1", "no line is of a photo of circle"),
        ("a.txt", "#\n0.5 0 0 0 0 0 1", "line 2 does not hold a pose"),
        ("a.txt", "0.5 0 0 0 0 0 0 0", "line 1 does not hold a pose"),
        ("a.txt", "0.5 0 nan 0 0 0 0 1", "line 1 does not hold a pose"),
        ("a.txt", "0.5 0 x 0 0 0 0 1", "line 1 does not hold a pose"),
        ("a.csv", "", "the header lacks name, tx"),
        ("a.csv", "name,tx,ty,tz,qx,qy,qz", "the header lacks qw"),
        ("a.csv", "name,tx,ty,tz,qx,qy,qz,qw\n0.5,0,0,0,0,0,0", "line 2 does not hold a pose"),
    ],
)
def test_priors_file_that_cannot_be_used(tmp_path, scene, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ValueError, match=f"{name}: {message}"):
        read_priors(path, scene)


@pytest.mark.parametrize(
    ("name", "data"),
    [
        pytest.param("a.txt", "\ufeff0.5 1.5 0 0 0 0 0 1 \r\n".encode(), id="byte order mark"),
        pytest.param("a.txt", b"0.5, 1.5, 0, 0, 0, 0, 0, 1\n", id="commas"),
        pytest.param("a.txt", "0.5\t1.5\t0\t0\t0\t0\t0\t1".encode("utf-16"), id="UTF-16"),
        pytest.param("A.CSV", b"Name,tx,ty,tz,qx,qy,qz,qw\r\n0.5,1.5,0,0,0,0,0,1\r\n", id="capitals"),
        pytest.param(
            "a.csv", "\ufeffname;tx;ty;tz;qx;qy;qz;qw\r\n0.5;1,5;0;0;0;0;0;1\r\n".encode(), id="decimal commas"
        ),
        pytest.param("a.csv", b"sep=;\nname;tx;ty;tz;qx;qy;qz;qw\n0.5;1.5;0;0;0;0;0;1\n", id="named delimiter"),
        pytest.param(
            "a.csv", "name\ttx\tty\ttz\tqx\tqy\tqz\tqw\n0.5\t1,5\t0\t0\t0\t0\t0\t1".encode("utf-16"), id="Unicode text"
        ),
    ],
)
def test_priors_files_as_windows_and_excel_write_them(tmp_path, scene, name, data):
    (tmp_path / name).write_bytes(data)
    (prior,) = read_priors(tmp_path / name, scene)
    np.testing.assert_allclose(prior.T_map_camera, make_pose(np.eye(3), [1.5, 0, 0]), atol=1e-12)


def test_priors_file_that_is_not_there(tmp_path, scene):
    with pytest.raises(ValueError, match=r"a\.txt: cannot be read: No such file"):
        read_priors(tmp_path / "a.txt", scene)


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
        self.device, self.solid_points = "cpu", np.empty((0, 3))

    def render(self, camera, T_map_camera):
        return self._render


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
    assert estimate.evidence.inliers == estimate.evidence.matches == len(a)


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
    assert estimate.evidence.matches == len(a)
    assert estimate.evidence.lifted == 0


def test_published_recipe_with_matches_of_nothing_has_no_pose():
    rng = np.random.default_rng(0)
    _, b, depth = shifted_pixels(rng, 30)
    localizer = PublishedLocalizer(GivenDepth(depth), GivenMatches(rng.uniform(0, 240, (30, 2)), b))
    estimate = localizer.localize(np.zeros((240, 320, 3), np.uint8), CAMERA, PRIOR)
    assert not estimate.localized or estimate.evidence.inliers < 10


@pytest.mark.parametrize("method", ["localize", "trace"])
def test_published_recipe_has_the_interface_of_the_localizer(method):
    ours, theirs = (
        [(each.name, each.kind, each.annotation, each.default is each.empty) for each in signature.parameters.values()]
        for signature in (inspect.signature(getattr(cls, method)) for cls in (Localizer, PublishedLocalizer))
    )
    assert theirs == ours


def test_published_recipe_traces_what_it_localizes():
    a, b, depth = shifted_pixels(np.random.default_rng(0))
    localizer = PublishedLocalizer(GivenDepth(depth), GivenMatches(a, b), max_image_width=160)
    image = np.random.default_rng(1).integers(0, 256, (240, 320, 3), np.uint8)
    trace = localizer.trace(image, CAMERA, PRIOR, np.eye(6))
    estimate = localizer.localize(image, CAMERA, PRIOR)
    np.testing.assert_array_equal(trace.estimate.T_map_camera, estimate.T_map_camera)
    assert trace.photo.image.shape == (120, 160, 3)
    assert trace.photo.camera.width == 160
    assert trace.render is None
    assert len(trace.correspondences) == 0


def test_published_recipe_is_given_up_on_request():
    a, b, depth = shifted_pixels(np.random.default_rng(0))
    localizer = PublishedLocalizer(GivenDepth(depth), GivenMatches(a, b))
    with pytest.raises(Interrupted):
        localizer.localize(np.zeros((240, 320, 3), np.uint8), CAMERA, PRIOR, interrupted=lambda: True)


# Measures


def moved(degrees, distance):
    return make_pose(so3_exp(np.radians([0.0, degrees, 0.0])), np.array([0.0, 0.0, distance]))


def answer(degrees, distance, covariance=None):
    evidence = Evidence(matches=30, inliers=20, passes=2)
    return Estimate(Status.LOCALIZED, "found", moved(degrees, distance), covariance, evidence)


FAILED = Estimate(Status.FAILED, "3 matches", evidence=Evidence(matches=3))
REJECTED = Estimate(
    Status.REJECTED, "no correlation", evidence=Evidence(matches=50, inliers=9, passes=2, reprojection_error_px=1.5)
)
PHOTO = PosedPhoto("a.png", Path("a.png"), CAMERA, np.eye(4))


def result(estimate, prior=None, prior_is_answer=False, milliseconds=10.0):
    """Measured against a camera at the origin, in a trajectory of radius 2."""
    prior = moved(20.0, 1.0) if prior is None else prior
    return measure(PHOTO, PhotoPrior(0, 3, prior), estimate, Cost(milliseconds, 15.0), Scoring(2.0, prior_is_answer))


def test_errors_of_an_answer():
    r = result(answer(3.0, 0.08))
    assert (r.rotation_error_deg, r.translation_error) == pytest.approx((3.0, 0.04))
    assert (r.prior_rotation_error_deg, r.prior_translation_error) == pytest.approx((20.0, 0.5))
    assert r.answered
    assert r.success
    assert (r.photo, r.step, r.milliseconds, r.cpu_milliseconds) == ("a.png", 3, 10.0, 15.0)


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


def test_a_rejected_estimate_is_no_answer():
    r = result(REJECTED)
    assert (r.status, r.answered, r.success, r.verdict) == ("rejected", False, False, "none")
    assert (r.evidence["matches"], r.evidence["inliers"], r.evidence["passes"]) == (50, 9, 2)
    assert r.evidence["reprojection_error_px"] == 1.5


def test_what_an_estimate_carries_is_kept_and_ready_for_json():
    estimate = replace(answer(1.0, 0.0), milliseconds={"render": 3.0, "total": 7.0})
    r = result(estimate)
    assert r.status == "localized"
    assert r.stage_milliseconds == {"render": 3.0, "total": 7.0}
    # Every number of the evidence is there, under its name and once, and what could not be measured is None.
    assert list(r.evidence) == [field.name for field in fields(Evidence)]
    assert not set(r.evidence) & {field.name for field in fields(QueryResult)}
    assert (r.evidence["inliers"], r.evidence["reprojection_error_px"]) == (20, None)
    assert r.nees is None
    assert r.in_ellipsoid is None
    assert r.protection_exceeded is None
    assert QueryResult(**json.loads(json.dumps(asdict(r), allow_nan=False))) == r


def test_nees_of_a_known_error():
    # Off by 0.3 along z and half a degree about y, with standard deviations of 0.1 and a quarter of a degree.
    covariance = np.diag([0.1**2] * 3 + [np.radians(0.25) ** 2] * 3)
    r = result(answer(0.5, 0.3, covariance))
    assert r.nees == pytest.approx((3**2 + 2**2) / 6)
    # 13 is over the 95 % quantile of the chi-square distribution with 6 degrees of freedom, 12.59.
    assert r.in_ellipsoid == {"50": False, "90": False, "95": False}
    assert result(answer(0.5, 0.28, covariance)).in_ellipsoid == {"50": False, "90": False, "95": True}
    assert result(answer(0.5, 0.11, covariance)).in_ellipsoid == {"50": True, "90": True, "95": True}


@pytest.mark.parametrize(("degrees", "sigmas", "exceeded"), [(0.0, 0.9, False), (0.0, 1.1, True), (1.1, 0.0, True)])
def test_an_error_beyond_either_protection_level_is_counted(degrees, sigmas, exceeded):
    covariance = np.diag([0.1**2] * 3 + [1e-6] * 3)
    level = protection_level(covariance)
    estimate = answer(degrees * np.degrees(level.angle), sigmas * level.radius, covariance)
    assert result(estimate).protection_exceeded is exceeded
    assert summarize([result(estimate), result(FAILED)])["protection_exceeded"] == int(exceeded)


def test_every_answer_to_a_negative_is_wrong():
    scoring = Scoring(2.0, negative=True)
    right = measure(PHOTO, PhotoPrior(0, 0, np.eye(4)), FAILED, Cost(1.0, 1.0), scoring)
    wrong = measure(PHOTO, PhotoPrior(0, 0, np.eye(4)), answer(0.0, 0.0, np.eye(6)), Cost(1.0, 1.0), scoring)
    assert (right.success, right.verdict) == (True, "none")
    assert (wrong.success, wrong.verdict) == (False, "wrong")
    # There is no truth that its covariance could be held against.
    assert wrong.nees is wrong.in_ellipsoid is wrong.protection_exceeded is None


def test_chi_square_distribution_is_that_of_the_tables():
    # Quantiles of Abramowitz and Stegun, table 26.8.
    quantiles = [1.63538, 5.34812, 10.6446, 12.5916, 16.8119]
    np.testing.assert_allclose(chi_square_cdf(np.array(quantiles)), [0.05, 0.5, 0.9, 0.95, 0.99], atol=1e-5)
    assert chi_square_cdf(0.0) == 0


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1))
def test_nees_is_calibrated_for_errors_of_the_covariance_itself(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) * [1, 1, 1, 1e-2, 1e-2, 1e-2]
    covariance = root.T @ root + 1e-8 * np.eye(6)
    errors = rng.multivariate_normal(np.zeros(6), covariance, size=400, method="eigh")
    # A rotation about the axes of the map frame multiplies from the left.
    answers = [make_pose(so3_exp(e[3:]) @ PRIOR[:3, :3], PRIOR[:3, 3] + e[:3]) for e in errors]
    nees = np.array([normalised_error(pose, covariance, PRIOR) for pose in answers])
    assert nees.mean() == pytest.approx(1.0, abs=0.2)
    assert np.mean(chi_square_cdf(6 * nees) < 0.9) == pytest.approx(0.9, abs=0.1)


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
    assert summary["cpu_milliseconds"] == {"median": 15.0}
    assert summary["milliseconds"] == pytest.approx({"median": 25.0, "p95": 38.5})
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_summary_of_the_covariances():
    # Errors along z in standard deviations; 6 NEES is their square, and 5.35, 10.6 and 12.6 are the limits.
    covariance = np.diag([0.01**2] * 3 + [1e-6] * 3)
    results = [result(answer(0.0, 0.01 * error, covariance)) for error in (1.0, 2.0, 3.0, 3.4)]
    results += [result(FAILED), result(answer(0.0, 0.0))]  # neither has a covariance
    summary = summarize(results)
    assert summary["nees_mean"] == pytest.approx((1 + 4 + 9 + 11.56) / 24)
    assert summary["nees_median"] == pytest.approx(6.5 / 6)
    assert summary["coverage"] == {"50": 0.5, "90": 0.75, "95": 1.0}
    none = summarize([result(FAILED)])
    assert (none["nees_mean"], none["nees_median"], none["coverage"]) == (None, None, None)


def test_best_of_a_photos_priors_has_the_smallest_error_for_its_limits():
    # A photo's errors over the limits: 0.5 (translation), 0.4 (rotation), no answer.
    results = [result(answer(0.5, 0.05)), result(answer(2.0, 0.01)), result(FAILED)]
    other = replace(result(answer(1.0, 0.0)), photo="b.png")
    assert best_of([*results, other]) == [results[1], other]
    assert best_of([]) == []


def test_success_by_step():
    results = [
        replace(result(answer(1.0, 0.0), prior=moved(10.0, 0.0)), step=1),
        replace(result(answer(9.0, 0.0), prior=moved(10.0, 0.0)), step=1),
        replace(result(FAILED, prior=moved(20.0, 1.0)), step=2),
    ]
    first, second = by_step(results)
    assert first["prior_rotation_error_deg"] == pytest.approx(10.0)
    assert (first["queries"], first["success_rate"], first["wrong_answers"]) == (2, 0.5, 1)
    assert second["prior_translation_error"] == pytest.approx(0.5)
    assert (second["queries"], second["success_rate"], second["wrong_answers"]) == (1, 0.0, 0)
    assert by_step([]) == []


# Ablation


@pytest.mark.slow
# That of parallax makes one where there is haze: test_parallax.py.
@pytest.mark.parametrize("ablation", sorted(set(ABLATIONS) - {"parallax"}))
def test_every_ablation_makes_a_difference(ablation, room_map, room_camera, room_photos):
    photo, matcher = room_photos[0], create_matcher("sift")
    renderer = create_renderer(room_map)
    options = LocalizerOptions(limits=Limits(max_risk=1.0), max_passes=1)
    components = Components(renderer, matcher, create_tracker, options)

    def answer(taken_out):
        localizer = ablated_localizer(components, taken_out)
        return localizer.localize(photo.image, room_camera, photo.T_map_camera_prior)

    whole, part = answer(""), answer(ablation)
    assert whole.localized
    assert part.localized, part.reason
    assert not np.array_equal(whole.T_map_camera, part.T_map_camera)
    assert translation_error(part.T_map_camera, photo.T_map_camera) < 0.05
    # Nothing is left behind: the next localizer is the whole one again.
    np.testing.assert_array_equal(answer("").T_map_camera, whole.T_map_camera)


@pytest.mark.parametrize("ablation", ["tracking", "sub-pixel"])
def test_trackers_of_ablations_find_the_renders_corners_in_the_photo(ablation, room_photos):
    image, matcher = room_photos[0].image, create_matcher("sift")
    shifted = np.roll(image, 3, axis=1)
    photo = Photo(image, np.ones(image.shape[:2], bool), Camera(image.shape[1], image.shape[0], CAMERA.K))
    tracker = FeatureTracker(matcher, photo, "cpu") if ablation == "tracking" else WholePixelTracker(photo, "cpu")
    for matches in (tracker.track(shifted), tracker.track_back(shifted)):
        assert len(matches) > 100
        np.testing.assert_allclose(np.median(matches.b - matches.a, axis=0), [3, 0], atol=0.6)
        if ablation == "sub-pixel":
            np.testing.assert_array_equal(matches.b, np.round(matches.b))


def test_an_ablation_that_is_not_known():
    renderer, matcher = GivenDepth(np.ones((240, 320))), GivenMatches([], [])
    with pytest.raises(ValueError, match="ablation 'renderer' is not one of tracking, sub-pixel"):
        ablated_localizer(Components(renderer, matcher, create_tracker, LocalizerOptions()), "renderer")
