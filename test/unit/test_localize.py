"""The pipeline on ray-traced photos of a room whose map was built by other code."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from asserts import assert_no_answer

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, rotation_error_deg, so3_exp, translation_error
from gsfeatloc_ros.localize.estimate import Status
from gsfeatloc_ros.localize.evidence import Limits
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.render import Render, create_renderer
from gsfeatloc_ros.simulate import simulate_photos


@pytest.fixture(scope="module")
def renderer(room_map):
    return create_renderer(room_map)


@pytest.fixture(scope="module", params=["sift", pytest.param("xfeat", marks=pytest.mark.slow)])
def localizer(renderer, request):
    return Localizer(renderer, create_matcher(request.param))


# The search is the same for all matchers.
sift_and_in_the_night_xfeat = pytest.mark.parametrize(
    "localizer", ["sift", pytest.param("xfeat", marks=pytest.mark.nightly)], indirect=True
)


@pytest.fixture(scope="module")
def sift_localizer(renderer):
    return Localizer(renderer, create_matcher("sift"))


def test_finds_the_camera_within_a_degree_and_two_centimetres(localizer, room_camera, room_photos) -> None:
    for photo in room_photos[:4]:
        estimate = localizer.localize(photo.image, room_camera, photo.T_map_camera_prior)
        assert estimate.status is Status.LOCALIZED, estimate.reason
        assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera) < 1.0
        assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.02


def test_a_picture_of_the_place_upside_down_is_none_of_it_unless_the_camera_is(sift_localizer, room) -> None:
    """As what covers most of a photo may be. The pose that it shows is right for a camera that is mounted so."""
    camera = Camera(640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]))
    (photo,) = simulate_photos(room, camera, count=1, seed=1)
    over = np.diag([-1.0, -1.0, 1.0, 1.0])
    picture = np.ascontiguousarray(photo.image[::-1, ::-1])
    estimate = sift_localizer.localize(picture, camera, photo.T_map_camera_prior)
    assert_no_answer(estimate)
    assert re.search("turned by 1[78][0-9] degrees about the camera's axis", estimate.reason), estimate.reason
    estimate = sift_localizer.localize(picture, camera, photo.T_map_camera_prior @ over)
    assert estimate.status is Status.LOCALIZED, estimate.reason
    assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera @ over) < 1.0


def test_the_answer_carries_its_evidence(sift_localizer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    estimate = sift_localizer.localize(photo.image, room_camera, photo.T_map_camera_prior)
    np.testing.assert_allclose(estimate.covariance, estimate.covariance.T, rtol=1e-6)
    assert np.linalg.eigvalsh(estimate.covariance)[0] > 0
    evidence = estimate.evidence
    assert 20 <= evidence.inliers <= evidence.lifted <= evidence.matches <= evidence.corners
    assert 0 < evidence.reprojection_error_px < 3.0
    assert 1 <= evidence.passes <= 4
    assert 0.5 < evidence.correlation <= 1.0
    assert 0.5 < evidence.coverage <= 1.0
    assert 0 < evidence.deviation < 8
    assert evidence.probability_wrong < 1e-4
    assert abs(evidence.focal_error) < 0.01
    assert evidence.blur_px == 0
    assert evidence.changed < 0.1
    assert estimate.protection.radius > 0.01
    assert {
        "prepare",
        "features",
        "render",
        "match",
        "track",
        "solve",
        "verify",
        "total",
    } <= estimate.milliseconds.keys()
    stages = sum(ms for stage, ms in estimate.milliseconds.items() if stage != "total")
    assert stages <= estimate.milliseconds["total"]


def test_the_same_seed_gives_the_same_answer(sift_localizer, room_camera, room_photos) -> None:
    photo = room_photos[1]
    a, b = (sift_localizer.localize(photo.image, room_camera, photo.T_map_camera_prior) for _ in range(2))
    np.testing.assert_array_equal(a.T_map_camera, b.T_map_camera)


def test_wide_photos_are_resized(renderer, room_camera, room_photos) -> None:
    narrow = Localizer(renderer, create_matcher("sift"), LocalizerOptions(max_image_width=480))
    photo = room_photos[2]
    trace = narrow.trace(photo.image, room_camera, photo.T_map_camera_prior)
    estimate = trace.estimate
    assert trace.photo.image.shape == trace.render.rgb.shape == (360, 480, 3)
    assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera) < 1.0
    assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.03


def test_the_trace_has_the_pictures_that_the_estimate_was_made_from(sift_localizer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    trace = sift_localizer.trace(photo.image, room_camera, photo.T_map_camera_prior)
    assert trace.photo.image.shape == trace.render.rgb.shape == (480, 640, 3)
    assert len(trace.correspondences) == trace.estimate.evidence.inliers
    # The render is within half a pixel of the answer: it shows what the photo does at nearly the same pixels.
    assert np.median(np.linalg.norm(trace.correspondences.a - trace.correspondences.b, axis=1)) < 1.0
    nothing = sift_localizer.trace(np.zeros_like(photo.image), room_camera, photo.T_map_camera_prior)
    assert nothing.render is None
    assert len(nothing.correspondences) == 0


def test_stages_are_measured_on_the_clock_that_is_given(renderer, room_camera, room_photos) -> None:
    ticks = itertools.count()
    localizer = Localizer(renderer, create_matcher("sift"), now=lambda: float(next(ticks)))
    photo = room_photos[0]
    milliseconds = localizer.localize(photo.image, room_camera, photo.T_map_camera_prior).milliseconds
    assert all(ms % 1000 == 0 for ms in milliseconds.values())
    assert milliseconds["prepare"] == 1000


@pytest.mark.parametrize("value", [0, 128, 255], ids=["black", "grey", "white"])
def test_a_photo_of_nothing_is_a_failure_with_a_reason(localizer, room_camera, room_photos, value: int) -> None:
    nothing = np.full((room_camera.height, room_camera.width, 3), value, np.uint8)
    estimate = localizer.localize(nothing, room_camera, room_photos[0].T_map_camera)
    assert_no_answer(estimate)
    assert "0 corners" in estimate.reason


def _covered(image: np.ndarray, share: float, spots: int) -> np.ndarray:
    """Leave a share of an image (H, W, 3) in so many square spots, one a strip; all else becomes black."""
    height, width = image.shape[:2]
    side = round(np.sqrt(share * height * width / spots))
    left = np.zeros_like(image)
    for spot in range(spots):
        x = round(width * (spot + 0.5) / spots - side / 2)
        y = (height - side) // 2 if spots == 1 else (spot * 97) % (height - side)
        left[y : y + side, x : x + side] = image[y : y + side, x : x + side]
    return left


@pytest.mark.parametrize(("share", "spots"), [(0.01, 1), (0.01, 12), (0.04, 1)])
def test_a_covered_lens_costs_no_search(sift_localizer, room_camera, room_photos, share: float, spots: int) -> None:
    photo = room_photos[0]
    estimate = sift_localizer.localize(_covered(photo.image, share, spots), room_camera, photo.T_map_camera)
    assert_no_answer(estimate)
    assert estimate.status is Status.FAILED
    assert "is the lens covered" in estimate.reason
    assert not {"render", "search"} & set(estimate.milliseconds)


def test_a_photo_that_is_half_covered_is_answered(sift_localizer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    image = _covered(photo.image, 0.5, 1)
    assert sift_localizer.localize(image, room_camera, photo.T_map_camera_prior).localized


@pytest.mark.slow
def test_a_prior_that_sees_nothing_is_a_failure(localizer, room_camera, room_photos) -> None:
    outside = make_pose(np.eye(3), np.array([0, 0, 1000.0]))
    assert_no_answer(localizer.localize(room_photos[0].image, room_camera, outside))


@pytest.mark.slow
@sift_and_in_the_night_xfeat
def test_noise_is_no_place(localizer, room_camera, room_photos) -> None:
    noise = np.random.default_rng(0).integers(0, 256, room_photos[0].image.shape, dtype=np.uint8)
    assert_no_answer(localizer.localize(noise, room_camera, room_photos[0].T_map_camera))


@pytest.mark.slow
@sift_and_in_the_night_xfeat
def test_mirrored_photos_are_rejected(localizer, room_camera, room_photos) -> None:
    """Seen from behind, through the wall, the room is mirrored: poses there match well, but are far from the prior."""
    for photo in room_photos[:2]:
        mirrored = np.ascontiguousarray(photo.image[:, ::-1])
        assert_no_answer(localizer.localize(mirrored, room_camera, photo.T_map_camera))


def test_a_prior_that_knows_better_does_not_veto_what_is_seen(sift_localizer, room_camera, room_photos) -> None:
    """The prior is 0.3 m and 10 degrees off at least, and claims to be sure."""
    photo = room_photos[0]
    estimate = sift_localizer.localize(photo.image, room_camera, photo.T_map_camera_prior, np.diag([1e-6] * 6))
    assert estimate.evidence.deviation > 8
    assert estimate.localized
    assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.02


def test_less_risk_is_taken_where_no_prior_expects_the_pose(renderer, sift_localizer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    near = sift_localizer.localize(photo.image, room_camera, photo.T_map_camera_prior)
    limits = Limits(max_risk=10 * near.evidence.probability_wrong)
    localizer = Localizer(renderer, create_matcher("sift"), LocalizerOptions(limits=limits))
    assert localizer.localize(photo.image, room_camera, photo.T_map_camera_prior).localized
    estimate = localizer.localize(photo.image, room_camera, photo.T_map_camera_prior, np.diag([1e-6] * 6))
    assert estimate.status is Status.REJECTED
    assert "standard deviations from the prior" in estimate.reason


@pytest.mark.slow
def test_the_estimate_is_verified_by_the_render_there(renderer, room_camera, room_photos) -> None:
    """What it is asked for and does not have is said; the pose is kept back."""
    photo = room_photos[0]
    demands = {
        "min_inliers": (800, "at least 800 needed"),
        "max_risk": (1e-30, "wrong with a probability of"),
        "min_coverage": (0.97, "of the photo"),
    }
    for option, (value, says) in demands.items():
        demanding = Localizer(
            renderer, create_matcher("sift"), LocalizerOptions(max_views=0, limits=Limits(**{option: value}))
        )
        estimate = demanding.localize(photo.image, room_camera, photo.T_map_camera_prior)
        assert estimate.status is Status.REJECTED
        assert_no_answer(estimate)
        assert says in estimate.reason
        assert estimate.evidence.passes >= 1


@pytest.mark.slow
def test_distortion_is_taken_out(sift_localizer, room_camera, room_photos) -> None:
    """Without the distortion coefficients far less of the same photo is as in the map."""
    photo = room_photos[0]
    pinhole = replace(room_camera, distortion=np.zeros(5))
    good = sift_localizer.localize(photo.image, room_camera, photo.T_map_camera_prior)
    bad = sift_localizer.localize(photo.image, pinhole, photo.T_map_camera_prior)
    assert good.evidence.changed < 0.05 < 0.2 < bad.evidence.changed
    assert good.evidence.inliers > 1.5 * bad.evidence.inliers
    assert translation_error(good.T_map_camera, photo.T_map_camera) < 0.01


@pytest.mark.parametrize(
    "image",
    [np.zeros((480, 640), np.uint8), np.zeros((480, 641, 3), np.uint8), np.zeros((480, 640, 3), np.float32)],
    ids=["grey", "other size", "float"],
)
def test_refuses_images_of_another_kind(sift_localizer, image) -> None:
    camera = Camera(640, 480, np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]))
    with pytest.raises(ValueError, match="expected an RGB image 640x480"):
        sift_localizer.localize(image, camera, np.eye(4))


@pytest.mark.parametrize("prior", [np.full((4, 4), np.nan), np.eye(3)], ids=["NaN", "3x3"])
def test_refuses_priors_that_are_no_pose(sift_localizer, room_camera, room_photos, prior) -> None:
    with pytest.raises(ValueError, match="prior"):
        sift_localizer.localize(room_photos[0].image, room_camera, prior)


def test_a_perfect_prior_is_confirmed(sift_localizer, room_camera, room_photos) -> None:
    photo = room_photos[3]
    estimate = sift_localizer.localize(
        photo.image, room_camera, photo.T_map_camera @ make_pose(so3_exp(np.zeros(3)), [0, 0, 0])
    )
    assert estimate.localized
    assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.02


def motion(image: np.ndarray, pixels: int) -> np.ndarray:
    """The photo of a camera that moved sideways."""
    return cv2.blur(image, (pixels, 1))


@pytest.mark.parametrize("pixels", [15, 25])
def test_a_blurred_photo_is_compared_with_a_render_blurred_alike(
    sift_localizer, room_camera, room_photos, pixels: int
) -> None:
    photo = room_photos[0]
    estimate = sift_localizer.localize(motion(photo.image, pixels), room_camera, photo.T_map_camera_prior)
    assert estimate.localized, estimate.reason
    assert estimate.evidence.blur_px == pytest.approx(pixels, rel=0.35)
    assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera) < 1.0
    assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.05


class CountingRenderer:
    """A renderer that remembers how wide its pictures were."""

    def __init__(self, renderer) -> None:
        self._renderer = renderer
        self.device, self.reading = renderer.device, renderer.reading
        self.widths: list[int] = []

    def render(self, camera: Camera, T_map_camera: np.ndarray) -> Render:
        self.widths.append(camera.width)
        return self._renderer.render(camera, T_map_camera)


@pytest.mark.parametrize("max_passes", [1, 2, 3])
def test_renders_of_a_blurred_photo_are_counted(renderer, room_camera, room_photos, max_passes: int) -> None:
    photo, counting = room_photos[0], CountingRenderer(renderer)
    localizer = Localizer(counting, create_matcher("sift"), LocalizerOptions(max_passes=max_passes, max_views=0))
    evidence = localizer.localize(motion(photo.image, 15), room_camera, photo.T_map_camera_prior).evidence
    assert evidence.blur_px > 0
    assert evidence.passes == counting.widths.count(640) <= max_passes


@pytest.mark.slow
@pytest.mark.parametrize("error", [-0.05, 0.05])
def test_a_wrong_focal_length_is_refused_and_told(sift_localizer, room_camera, room_photos, error: float) -> None:
    told = 0
    for photo in room_photos[:3]:
        camera = replace(room_camera, K=room_camera.K @ np.diag([1 + error, 1 + error, 1]))
        estimate = sift_localizer.localize(photo.image, camera, photo.T_map_camera_prior)
        assert_no_answer(estimate)
        # It is the camera's own that fits: shorter by what was given too long.
        told += abs(estimate.evidence.focal_error + error / (1 + error)) < 0.02
        assert "focal length" in estimate.reason or "wrong with a probability" in estimate.reason
    assert told >= 2


def test_what_covers_the_photo_does_not_count(sift_localizer, room_camera, room_photos) -> None:
    """Something in front of the camera, textured like the room itself: another part of the photo, turned."""
    photo = room_photos[0]
    image = photo.image.copy()
    image[100:380, 150:490] = photo.image[60:340, 300:640][::-1, ::-1]
    trace = sift_localizer.trace(image, room_camera, photo.T_map_camera_prior)
    assert trace.estimate.localized, trace.estimate.reason
    assert rotation_error_deg(trace.estimate.T_map_camera, photo.T_map_camera) < 1.0
    changed = trace.changed()
    assert changed[140:340, 190:450].mean() > 2 * changed[:80].mean()
    assert 0.1 < trace.estimate.evidence.changed < 0.6


class Ticks:
    """A clock that is asked: each time it is a second later."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        self.seconds += 1.0
        return self.seconds


def test_a_deadline_ends_a_query_without_a_half_believed_pose(renderer, room_camera, room_photos) -> None:
    photo, matcher = room_photos[0], create_matcher("sift")

    def localized(deadline):
        ticks = Ticks()
        localizer = Localizer(renderer, matcher, LocalizerOptions(deadline=deadline), now=ticks)
        return localizer.localize(photo.image, room_camera, photo.T_map_camera_prior), ticks.seconds

    answer, needed = localized(0.0)
    assert answer.status is Status.LOCALIZED
    for deadline in np.linspace(0.5, needed, 5):
        estimate, taken = localized(float(deadline))
        if deadline > needed - 2:
            np.testing.assert_array_equal(estimate.T_map_camera, answer.T_map_camera)
            continue
        assert_no_answer(estimate)
        assert estimate.status in (Status.FAILED, Status.REJECTED)
        assert estimate.reason.startswith(f"not found within {deadline:.2f} s: looked ")
        assert taken <= deadline + 5


def test_a_deadline_says_what_was_looked_at(renderer, room_camera, room_photos) -> None:
    prior = room_photos[0].T_map_camera_prior @ make_pose(so3_exp(np.array([0.0, np.pi, 0.0])), np.zeros(3))

    def reason(deadline):
        localizer = Localizer(renderer, create_matcher("sift"), LocalizerOptions(deadline=deadline), now=Ticks())
        estimate = localizer.localize(room_photos[0].image, room_camera, prior)
        assert_no_answer(estimate)
        return estimate.reason

    assert "looked nowhere yet" in reason(1.0)
    assert "looked at the prior and in 8 views around it" in reason(40.0)
