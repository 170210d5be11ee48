"""The pinhole camera and its distortion."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gsfeatloc_ros.common.camera import Camera

K = np.array([[520.0, 0.0, 322.3], [0.0, 515.0, 236.7], [0.0, 0.0, 1.0]])

cameras = st.builds(
    lambda width, height, focal, cx, cy: Camera(
        width, height, np.array([[focal * width, 0, cx * width], [0, 1.1 * focal * width, cy * height], [0, 0, 1]])
    ),
    st.integers(1, 4000),
    st.integers(1, 4000),
    st.floats(0.3, 3),
    st.floats(0.2, 0.8),
    st.floats(0.2, 0.8),
)
points_in_front = arrays(np.float64, (5, 3), elements=st.floats(-2, 2)).map(lambda points: points + np.array([0, 0, 4]))

# Real lenses: a webcam, a wide rational one, a fisheye.
LENSES = [
    ("plumb_bob", [-0.28, 0.09, 0.0012, -0.0008, -0.01]),
    ("plumb_bob", [0.1, -0.2, 0.001, 0.0005]),
    ("rational_polynomial", [3.1, 1.2, 0.0003, -0.0001, 0.05, 3.4, 2.2, 0.3]),
    ("equidistant", [-0.02, 0.004, -0.003, 0.0005]),
]


def distort(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Observed pixels of camera-frame points by OpenCV's forward model."""
    zero = np.zeros(3)
    if camera.model == "equidistant":
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.K, camera.distortion)
    else:
        pixels, _ = cv2.projectPoints(points[:, None], zero, zero, camera.K, camera.distortion)
    return pixels.reshape(-1, 2)


def test_projection_by_hand():
    pixels = Camera(640, 480, K).project(np.array([[0.0, 0.0, 2.0], [0.2, -0.4, 2.0]]))
    np.testing.assert_allclose(pixels, [[322.3, 236.7], [322.3 + 52.0, 236.7 - 103.0]])


@given(cameras, points_in_front)
def test_rays_go_through_the_pixels_of_points(camera, points):
    rays = camera.rays(camera.project(points))
    np.testing.assert_allclose(rays * points[:, 2:], points, atol=1e-9)


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_undistort_inverts_the_lens(model, coefficients):
    camera = Camera(640, 480, K, np.array(coefficients), model)
    columns, rows = np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 9))
    pinhole = np.column_stack([columns.ravel(), rows.ravel()])
    observed = distort(camera, camera.rays(pinhole))
    assert np.abs(observed - pinhole).max() > 2  # the lens does something
    np.testing.assert_allclose(camera.undistort(observed), pinhole, atol=1e-3)


def observed_by_the_definition(camera: Camera, slopes: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) that see the slopes (N, 2) x/z and y/z, by the models' formulas and the whole K; without OpenCV."""
    x, y = slopes.T
    r = np.hypot(x, y)
    if camera.model == "equidistant":
        theta, powers = np.arctan(r), np.arange(3, 10, 2)
        bent = theta + (camera.distortion[:, None] * theta ** powers[:, None]).sum(axis=0)
        x, y = x * bent / np.maximum(r, 1e-12), y * bent / np.maximum(r, 1e-12)
    else:
        k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(camera.distortion, (0, 8 - len(camera.distortion)))
        radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
            y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
        )
    return np.column_stack([x, y, np.ones_like(x)]) @ camera.K[:2].T


@pytest.mark.parametrize("skew", [-20.0, 5.0])
@pytest.mark.parametrize(("model", "coefficients"), [*LENSES, ("plumb_bob", [])])
def test_skew_is_undistorted_with_the_lens(model, coefficients, skew):
    """Pixels, and pictures of a smooth pattern, which the definition says where to look for."""
    skewed = Camera(640, 480, K + np.diag([skew, 0.0], k=1), np.array(coefficients), model)
    columns, rows = np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 9))
    slopes = (np.column_stack([columns.ravel(), rows.ravel()]) - K[:2, 2]) / K[[0, 1], [0, 1]]
    seen_at = skewed.undistort(observed_by_the_definition(skewed, slopes))
    np.testing.assert_allclose(seen_at, slopes * K[[0, 1], [0, 1]] + K[:2, 2], atol=1e-3)
    np.testing.assert_array_equal(skewed.pinhole().K, K)
    np.testing.assert_allclose(skewed.rays(seen_at)[:, :2], slopes, atol=1e-5)

    def pattern(x, y):
        return 128 + 50 * np.sin(0.05 * x) + 50 * np.cos(0.03 * y)

    y, x = np.mgrid[:480, :640]
    undistorted = skewed.undistort_image(pattern(x, y).astype(np.float32))
    slopes = np.column_stack([(x.ravel() - K[0, 2]) / K[0, 0], (y.ravel() - K[1, 2]) / K[1, 1]])
    observed_x, observed_y = observed_by_the_definition(skewed, slopes).T.reshape(2, 480, 640)
    inside = (observed_x > 0) & (observed_x < 639) & (observed_y > 0) & (observed_y < 479)
    assert inside.mean() > 0.5
    assert np.abs(undistorted - pattern(observed_x, observed_y))[inside].max() < 0.5


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_pictures_are_undistorted_as_by_opencv(model, coefficients):
    camera, D = Camera(640, 480, K, np.array(coefficients), model), np.array(coefficients, np.float64)
    image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    everywhere = np.full((480, 640), 255, np.uint8)
    for picture, ours in ((image, camera.undistort_image(image)), (everywhere, 255 * camera.seen().astype(np.uint8))):
        if model == "equidistant":
            expected = cv2.fisheye.undistortImage(picture, K, D, Knew=K)
        else:
            expected = cv2.undistort(picture, K, D)
        if picture is everywhere:
            expected[expected < 255] = 0
        np.testing.assert_array_equal(ours, expected)


def test_a_pinhole_camera_sees_everywhere():
    assert Camera(64, 48, K).seen().all()


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_undistort_of_no_pixels(model, coefficients):
    assert Camera(640, 480, K, np.array(coefficients), model).undistort(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize("distortion", [[], [0, 0, 0, 0], [0, 0, 0, 0, 0]])
def test_without_distortion_pixels_stay(distortion):
    pixels = np.random.default_rng(0).uniform(0, 480, (10, 2))
    undistorted = Camera(640, 480, K, np.array(distortion)).undistort(pixels)
    np.testing.assert_array_equal(undistorted, pixels)
    assert undistorted is not pixels


def test_equidistant_without_coefficients_is_still_a_fisheye():
    # The equidistant model r = f theta is not a pinhole even when all its coefficients are zero.
    camera = Camera(640, 480, K, np.zeros(4), "equidistant")
    points = np.array([[1.0, 0.5, 1.0], [-0.6, 0.4, 1.0]])
    np.testing.assert_allclose(camera.undistort(distort(camera, points)), camera.project(points), atol=1e-6)


@given(cameras, points_in_front, st.integers(1, 4000), st.integers(1, 4000))
def test_scaling_maps_pixels_as_resizing_an_image_does(camera, points, width, height):
    scale = np.array([width / camera.width, height / camera.height])
    # Resizing keeps the image's borders, which lie half a pixel outside the centres of its border pixels.
    expected = (camera.project(points) + 0.5) * scale - 0.5
    np.testing.assert_allclose(camera.scaled(width, height).project(points), expected, atol=1e-6)


def test_scaling_agrees_with_cv2_resize():
    image = np.zeros((480, 640), dtype=np.float32)
    image[200:204, 320:324] = 1.0  # a spot of 4x4 pixels, its centre at (321.5, 201.5)
    small = cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA)
    rows, columns = np.nonzero(small)
    camera = Camera(640, 480, np.array([[500.0, 0, 321.5], [0, 500.0, 201.5], [0, 0, 1]]))
    np.testing.assert_allclose(camera.scaled(160, 120).K[:2, 2], [columns[0], rows[0]])
    assert len(rows) == 1


@given(cameras, st.integers(1, 4000))
def test_scaling_back_gives_the_camera(camera, width):
    again = camera.scaled(width, 480).scaled(camera.width, camera.height)
    assert (again.width, again.height) == (camera.width, camera.height)
    np.testing.assert_allclose(again.K, camera.K, rtol=1e-9, atol=1e-6)


@given(cameras, st.integers(1, 4000))
def test_limited_keeps_the_proportions(camera, max_width):
    limited = camera.limited(max_width)
    assert limited.width == min(camera.width, max_width)
    if limited is not camera:
        assert abs(limited.height - max(1, camera.height * max_width / camera.width)) <= 0.5
        assert limited.fov_x == pytest.approx(camera.fov_x)


def test_scaling_keeps_the_lens():
    model, coefficients = LENSES[0]
    camera = Camera(640, 480, K, np.array(coefficients), model)
    points = np.array([[0.5, 0.3, 1.0]])
    small = camera.scaled(320, 240)
    np.testing.assert_allclose(distort(small, points), (distort(camera, points) + 0.5) / 2 - 0.5, atol=1e-9)


def test_field_of_view():
    assert Camera(640, 480, np.diag([320.0, 320.0, 1.0])).fov_x == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "size"),
        ({"height": -1}, "size"),
        ({"K": np.zeros((3, 3))}, "calibrate"),
        ({"K": np.diag([500.0, -500.0, 1.0])}, "focal"),
        ({"K": np.diag([500.0, np.nan, 1.0])}, "finite"),
        ({"K": np.diag([500.0, 500.0, 2.0])}, "upper triangular"),
        ({"K": K.T}, "upper triangular"),
        ({"distortion": np.array([np.inf, 0, 0, 0])}, "finite"),
        ({"distortion": np.zeros(3)}, "coefficients"),
        ({"distortion": np.zeros(5), "model": "equidistant"}, "coefficients"),
        ({"model": "kannala"}, "model"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Camera(**({"width": 640, "height": 480, "K": K} | change))


@pytest.mark.parametrize(("width", "height"), [(160, 120), (120, 160), (1, 200), (3, 2000), (640, 480)])
def test_enlarging_keeps_both_sides_within_bounds(width: int, height: int) -> None:
    camera = Camera(width, height, np.array([[100.0, 0, 0.5 * width], [0, 100.0, 0.5 * height], [0, 0, 1]]))
    larger = camera.enlarged(500.0, 640)
    assert max(larger.width, larger.height) <= max(640, width, height)
    assert larger.width >= width
    assert larger.height >= height
    assert larger.K[0, 0] <= 500.5


def test_a_centred_camera_looks_along_the_middle_of_its_image() -> None:
    camera = Camera.centred(320, 240, 288.0)
    np.testing.assert_allclose(camera.project(np.array([[0.0, 0.0, 2.0]])), [[159.5, 119.5]])
    assert camera.fov_x == pytest.approx(2 * np.arctan(160 / 288))
    assert not camera.distorted


def test_a_longer_lens_shows_things_farther_from_the_middle() -> None:
    camera = Camera(640, 480, np.array([[500.0, 2.0, 310.0], [0, 520.0, 250.0], [0, 0, 1]]))
    points = np.array([[0.4, -0.2, 2.0], [-0.1, 0.5, 1.0], [0.0, 0.0, 3.0]])
    off = camera.project(points) - [310.0, 250.0]
    np.testing.assert_allclose(camera.zoomed(0.1).project(points) - [310.0, 250.0], 1.1 * off)
