"""What speaks for an answer, and what is made of it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.localize.evidence import (
    Evidence,
    Limits,
    correlation,
    coverage,
    deviation,
    inlier_ratio,
    verdict,
)
from gsfeatloc_ros.render import Render, create_renderer

GOOD = Evidence(
    corners=800,
    matches=700,
    lifted=600,
    inliers=590,
    inlier_ratio=0.99,
    coverage=0.8,
    correlation=0.9,
    reprojection_error_px=0.4,
    deviation=1.2,
    passes=2,
    views=3,
)


def test_good_evidence_has_nothing_against_it() -> None:
    assert verdict(GOOD, Limits()) == ()


@pytest.mark.parametrize(
    ("name", "limit", "beyond", "says"),
    [
        ("inliers", 20, 19, "at least 20 needed"),
        ("inlier_ratio", 0.94, 0.9399, "at least 0.94 needed"),
        ("coverage", 0.1, 0.0999, "at least 10% needed"),
        ("correlation", 0.3, 0.2999, "at least 0.3 needed"),
        ("deviation", 8.0, 8.0001, "standard deviations from the prior (at most 8)"),
    ],
)
def test_each_limit_is_exact_and_named(name: str, limit: float, beyond: float, says: str) -> None:
    assert verdict(replace(GOOD, **{name: limit}), Limits()) == ()
    (reason,) = verdict(replace(GOOD, **{name: beyond}), Limits())
    assert says in reason


def test_limits_are_those_that_are_given() -> None:
    limits = Limits(600, 0.995, 0.9, 0.95, 1.0)
    assert len(verdict(GOOD, limits)) == 5
    assert (
        verdict(replace(GOOD, inliers=600, inlier_ratio=1.0, coverage=1.0, correlation=1.0, deviation=0.5), limits)
        == ()
    )


def test_no_inliers_are_the_only_reason() -> None:
    (reason,) = verdict(Evidence(corners=5, matches=3, lifted=2), Limits())
    assert "nothing in common: 5 corners in the photo, 3 found in the render, 2 with depth, 0 inliers" in reason


def test_a_correlation_that_cannot_be_said_is_a_reason() -> None:
    (reason,) = verdict(replace(GOOD, correlation=float("nan")), Limits())
    assert "correlation nan" in reason


def test_numbers_and_texts_have_the_same_names() -> None:
    assert list(GOOD.numbers()) == list(GOOD.texts())
    assert GOOD.numbers()["inlier_ratio"] == 0.99
    assert GOOD.texts() == {
        "corners": "800",
        "matches": "700",
        "lifted": "600",
        "inliers": "590",
        "inlier_ratio": "0.990",
        "coverage": "0.800",
        "correlation": "0.900",
        "reprojection_error_px": "0.400",
        "deviation": "1.200",
        "passes": "2",
        "views": "3",
    }
    assert Evidence().texts()["correlation"] == "nan"


def test_a_blurred_photo_is_given_more_room_up_to_twice_the_error() -> None:
    assert inlier_ratio(np.array([0.1, 0.2, 3.1, 0.2]), 3.0) == 0.75
    assert inlier_ratio(np.array([1.4, 1.4, 5.5, 1.4, 7.0]), 3.0) == 0.8
    assert inlier_ratio(np.array([4.0, 4.0, 5.9, 6.1]), 3.0) == 0.75


@given(st.lists(st.floats(0, 100), min_size=1, max_size=50))
def test_inliers_are_within_once_and_twice_the_error(errors: list[float]) -> None:
    ratio = inlier_ratio(np.array(errors), 3.0)
    assert np.mean(np.array(errors) <= 3.0) <= ratio <= np.mean(np.array(errors) <= 6.0)


def test_deviation_counts_standard_deviations_of_the_prior() -> None:
    default = np.diag([0.25] * 3 + [0.04] * 3)
    moved = make_pose(so3_exp(np.array([0.0, 0.4, 0.0])), np.array([0.5, 0.0, 0.0]))
    # A hundredth of the default variance is added.
    assert deviation(moved, np.eye(4), default, default) == pytest.approx(np.sqrt((1 + 4) / 1.01))
    assert deviation(np.eye(4), np.eye(4), default, default) == 0
    # What a prior claims to know exactly is given a tenth of the default deviation.
    assert deviation(moved, np.eye(4), np.zeros((6, 6)), default) == pytest.approx(np.sqrt((1 + 4) / 0.01))


@given(st.lists(st.tuples(st.floats(-0.5, 639.4), st.floats(-0.5, 479.4)), max_size=60))
def test_coverage_counts_the_cells_that_hold_a_pixel(pixels) -> None:
    cells = {(int((x + 0.5) // 80), int((y + 0.5) // 80)) for x, y in pixels}
    assert coverage(np.array(pixels).reshape(-1, 2), 640, 480) == len(cells) / 48


def test_coverage_is_full_when_every_cell_is_hit() -> None:
    x, y = np.meshgrid(np.arange(0, 640, 40), np.arange(0, 480, 40))
    assert coverage(np.column_stack([x.ravel(), y.ravel()]), 640, 480) == 1.0


def correlated(image: np.ndarray, camera: Camera, render: Render) -> float:
    """Correlation of a photo as `camera` observed it with a render."""
    return correlation(Photo.undistorted(image, camera, camera.width), render)


@pytest.fixture(scope="module")
def seen(room_map, room_camera, room_photos):
    """A photo and the render at its true pose."""
    photo = room_photos[0]
    return photo.image, create_renderer(room_map).render(room_camera, photo.T_map_camera)


def test_photo_agrees_with_the_render_at_the_truth(seen, room_camera) -> None:
    image, render = seen
    assert correlated(image, room_camera, render) > 0.8


@pytest.mark.parametrize("gain", [0.5, 1.3])
@pytest.mark.parametrize("gamma", [0.7, 1.5])
def test_exposure_does_not_count(seen, room_camera, gain: float, gamma: float) -> None:
    image, render = seen
    exposed = (255 * np.clip(gain * (image / 255.0) ** gamma, 0, 1)).astype(np.uint8)
    assert correlated(exposed, room_camera, render) > correlated(image, room_camera, render) - 0.1


def test_the_render_at_another_place_does_not_agree(seen, room_map, room_camera, room_photos) -> None:
    image, _ = seen
    elsewhere = create_renderer(room_map).render(room_camera, room_photos[4].T_map_camera)
    assert abs(correlated(image, room_camera, elsewhere)) < 0.3


def test_a_mirrored_photo_does_not_agree(seen, room_camera) -> None:
    image, render = seen
    assert correlated(np.ascontiguousarray(image[:, ::-1]), room_camera, render) < 0.3


def test_distortion_is_taken_out_first(seen, room_camera) -> None:
    image, render = seen
    pinhole = replace(room_camera, distortion=np.zeros(5))
    assert correlated(image, room_camera, render) > correlated(image, pinhole, render) + 0.05


def test_fisheye_photos_are_undistorted_too(seen, room_camera) -> None:
    _, render = seen
    fisheye = Camera(640, 480, room_camera.K, np.array([0.02, -0.01, 0.003, 0.0]), "equidistant")
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1).reshape(-1, 2)
    where = fisheye.undistort(pixels).astype(np.float32).reshape(480, 640, 2)
    image = cv2.remap(render.image(), where, None, cv2.INTER_LINEAR)
    assert correlated(image, fisheye, render) > 0.9


@pytest.mark.parametrize("value", [0, 128, 255])
def test_nothing_can_be_said_of_two_blank_images(value: int) -> None:
    blank = np.full((48, 64), value / 255, np.float32)
    render = Render(np.stack([blank] * 3, axis=2), blank, blank, blank, np.ones_like(blank))
    camera = Camera(64, 48, np.array([[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]]))
    assert np.isnan(correlated(render.image(), camera, render))


def test_what_the_map_does_not_cover_is_not_compared(seen, room_camera) -> None:
    image, render = seen
    uncovered = replace(render, alpha=np.zeros_like(render.alpha))
    assert np.isnan(correlated(image, room_camera, uncovered))
