"""Where a prior is good enough to track the photo into the render there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, isotropic_covariance, make_pose, moved, so3_exp, transform
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions, SearchOptions
from gsfeatloc_ros.localize.prior import Prior
from gsfeatloc_ros.localize.reach import expected_offset, is_settled, is_worth_tracking, may_be_settled
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.render import Render, Renderer, create_renderer

CAMERA = Camera(320, 240, np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]]))
POSE = make_pose(so3_exp(np.array([0.3, -0.2, 1.0])), np.array([1.0, 2.0, 3.0]))
SURE = isotropic_covariance(0.01, np.radians(0.5))
UNSURE = isotropic_covariance(2.0, np.radians(60.0))


def wall(depth: float) -> Render:
    """A render that is as far away everywhere."""
    flat = np.full((240, 320), depth, np.float32)
    return Render(np.zeros((240, 320, 3), np.float32), flat, flat, np.zeros_like(flat), np.ones_like(flat))


def prior(covariance: np.ndarray) -> Prior:
    return Prior(POSE, covariance, LocalizerOptions().prior_covariance(), covariance)


def test_where_the_map_shows_nothing_it_is_not_tracked() -> None:
    nothing = wall(np.nan)
    assert expected_offset(nothing, CAMERA, prior(SURE)) == np.inf
    assert not is_worth_tracking(nothing, CAMERA, prior(SURE))


@pytest.mark.parametrize("sigmas", [(0.02, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.01, 0.0, 0.02), (0.03,) * 6])
def test_the_offset_is_that_of_poses_drawn_from_the_covariance(sigmas: tuple[float, ...]) -> None:
    covariance = np.diag(np.square(sigmas))
    pixels = np.stack(np.meshgrid(np.arange(20, 320, 40), np.arange(20, 240, 40)), axis=-1).reshape(-1, 2)
    points = transform(POSE, 2.0 * CAMERA.rays(pixels.astype(float)))
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(2000, 6)) * sigmas
    seen = np.array([CAMERA.project(transform(invert(moved(POSE, step)), points)) for step in steps])
    expected = np.median(np.sqrt(((seen - pixels) ** 2).sum(axis=2).mean(axis=0)))
    assert expected_offset(wall(2.0), CAMERA, prior(covariance)) == pytest.approx(expected, rel=0.05)


def test_the_farther_the_map_the_less_a_shift_matters() -> None:
    shifted = prior(isotropic_covariance(0.3, np.radians(0.1)))
    assert not is_worth_tracking(wall(0.4), CAMERA, shifted)
    assert is_worth_tracking(wall(10.0), CAMERA, shifted)


def test_a_sure_prior_is_tracked_and_an_unsure_one_is_not() -> None:
    assert is_worth_tracking(wall(2.0), CAMERA, prior(SURE))
    assert is_worth_tracking(wall(2.0), CAMERA, prior(np.zeros((6, 6))))
    assert not is_worth_tracking(wall(2.0), CAMERA, prior(UNSURE))


def test_of_an_answer_that_is_gone_on_from_counts_how_far_off_it_usually_is() -> None:
    search = SearchOptions(usual_covariance=SURE)
    known = Prior.of(POSE, UNSURE, LocalizerOptions(search=search))
    assert is_worth_tracking(wall(2.0), CAMERA, known)
    assert known.deviation(moved(POSE, np.full(6, 0.5))) == prior(UNSURE).deviation(moved(POSE, np.full(6, 0.5)))


@pytest.mark.parametrize(
    ("metres", "degrees", "settled"), [(0.001, 0.05, True), (0.001, 1.0, False), (0.1, 0.05, False)]
)
def test_what_is_known_to_a_pixel_is_settled(metres: float, degrees: float, settled: bool) -> None:
    known = prior(isotropic_covariance(metres, np.radians(degrees)))
    assert is_settled(wall(2.0), CAMERA, known) == settled
    assert may_be_settled(CAMERA, known) or not settled
    assert not is_settled(wall(np.nan), CAMERA, known)


class Recording:
    """A renderer that keeps the widths of what it drew."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer, self.widths = renderer, []

    def __getattr__(self, name: str) -> object:
        return getattr(self._renderer, name)

    def render(self, camera: Camera, T_map_camera: np.ndarray) -> Render:
        self.widths.append(camera.width)
        return self._renderer.render(camera, T_map_camera)


def test_a_stream_takes_one_look_an_image(room_map, room_camera, room_photos) -> None:
    """What is known to a pixel is rendered once, in full size; a claim that is false is found out and mended."""
    photo, renderer = room_photos[0], Recording(create_renderer(room_map))
    localizer = Localizer(renderer, create_matcher("sift"))
    known = isotropic_covariance(0.002, np.radians(0.03))
    answer = localizer.localize(photo.image, room_camera, photo.T_map_camera, isotropic_covariance(0.02, 0.01))
    renderer.widths.clear()
    again = localizer.localize(photo.image, room_camera, answer.T_map_camera, known)
    assert renderer.widths == [room_camera.width]
    np.testing.assert_allclose(again.T_map_camera, answer.T_map_camera, atol=1e-3)
    off = moved(answer.T_map_camera, np.array([0.02, -0.01, 0.02, 0.01, -0.02, 0.01]))
    mended = localizer.localize(photo.image, room_camera, off, known)
    assert len(renderer.widths) > 2
    np.testing.assert_allclose(mended.T_map_camera, answer.T_map_camera, atol=2e-3)


@pytest.fixture(scope="module")
def localizer(room_map):
    return Localizer(create_renderer(room_map), create_matcher("sift"))


def test_from_a_good_prior_no_features_are_needed(localizer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    near = moved(photo.T_map_camera, np.array([0.02, -0.01, 0.02, 0.01, -0.02, 0.01]))
    estimate = localizer.localize(photo.image, room_camera, near, isotropic_covariance(0.02, np.radians(1.0)))
    assert estimate.localized, estimate.reason
    assert not {"features", "match", "search"} & estimate.milliseconds.keys()
    assert estimate.evidence.views == 0
    by_features = localizer.localize(photo.image, room_camera, near, UNSURE)
    assert by_features.localized
    assert {"features", "match"} <= by_features.milliseconds.keys()
    # What suggested the pose does not matter to it.
    np.testing.assert_allclose(estimate.T_map_camera, by_features.T_map_camera, atol=2e-3)
    # What neighbouring residuals have in common differs a little.
    sigmas = (np.sqrt(np.diag(each.covariance)) for each in (estimate, by_features))
    np.testing.assert_allclose(*sigmas, rtol=0.5)


def test_a_prior_that_claims_too_much_is_found_out(localizer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    wrong = moved(photo.T_map_camera, np.array([0.3, -0.1, 0.2, 0.1, -0.2, 0.1]))
    estimate = localizer.localize(photo.image, room_camera, wrong, isotropic_covariance(0.02, np.radians(1.0)))
    if estimate.localized:
        np.testing.assert_allclose(estimate.T_map_camera, photo.T_map_camera, atol=0.02)
    assert "features" in estimate.milliseconds


def test_a_flipped_photo_is_refused_from_the_pose_where_it_was_taken(localizer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    flipped = replace(photo, image=np.ascontiguousarray(photo.image[:, ::-1]))
    estimate = localizer.localize(flipped.image, room_camera, photo.T_map_camera, SURE)
    assert not estimate.localized
