"""What an answer must show before it is believed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.localize.evidence import agreement, coverage
from gsfeatloc_ros.render import Render, create_renderer


@given(st.lists(st.tuples(st.floats(-0.5, 639.4), st.floats(-0.5, 479.4)), max_size=60))
def test_coverage_counts_the_cells_that_hold_a_pixel(pixels) -> None:
    cells = {(int((x + 0.5) // 80), int((y + 0.5) // 80)) for x, y in pixels}
    assert coverage(np.array(pixels).reshape(-1, 2), 640, 480) == len(cells) / 48


def test_coverage_is_full_when_every_cell_is_hit() -> None:
    x, y = np.meshgrid(np.arange(0, 640, 40), np.arange(0, 480, 40))
    assert coverage(np.column_stack([x.ravel(), y.ravel()]), 640, 480) == 1.0


def correlation(image: np.ndarray, camera: Camera, render: Render) -> float:
    """Of a photo as `camera` observed it with a render."""
    return agreement(Photo.undistorted(image, camera, camera.width), render)


@pytest.fixture(scope="module")
def seen(room_map, room_camera, room_photos):
    """A photo and the render at its true pose."""
    photo = room_photos[0]
    return photo.image, create_renderer(room_map).render(room_camera, photo.T_map_camera)


def test_photo_agrees_with_the_render_at_the_truth(seen, room_camera) -> None:
    image, render = seen
    assert correlation(image, room_camera, render) > 0.8


@pytest.mark.parametrize("gain", [0.5, 1.3])
@pytest.mark.parametrize("gamma", [0.7, 1.5])
def test_exposure_does_not_count(seen, room_camera, gain: float, gamma: float) -> None:
    image, render = seen
    exposed = (255 * np.clip(gain * (image / 255.0) ** gamma, 0, 1)).astype(np.uint8)
    assert correlation(exposed, room_camera, render) > correlation(image, room_camera, render) - 0.1


def test_the_render_at_another_place_does_not_agree(seen, room_map, room_camera, room_photos) -> None:
    image, _ = seen
    elsewhere = create_renderer(room_map).render(room_camera, room_photos[4].T_map_camera)
    assert abs(correlation(image, room_camera, elsewhere)) < 0.3


def test_a_mirrored_photo_does_not_agree(seen, room_camera) -> None:
    image, render = seen
    assert correlation(np.ascontiguousarray(image[:, ::-1]), room_camera, render) < 0.3


def test_distortion_is_taken_out_first(seen, room_camera) -> None:
    image, render = seen
    pinhole = replace(room_camera, distortion=np.zeros(5))
    assert correlation(image, room_camera, render) > correlation(image, pinhole, render) + 0.05


def test_fisheye_photos_are_undistorted_too(seen, room_camera) -> None:
    _, render = seen
    fisheye = Camera(640, 480, room_camera.K, np.array([0.02, -0.01, 0.003, 0.0]), "equidistant")
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1).reshape(-1, 2)
    where = fisheye.undistort(pixels).astype(np.float32).reshape(480, 640, 2)
    image = cv2.remap(render.image(), where, None, cv2.INTER_LINEAR)
    assert correlation(image, fisheye, render) > 0.9


@pytest.mark.parametrize("value", [0, 128, 255])
def test_nothing_can_be_said_of_two_blank_images(value: int) -> None:
    blank = np.full((48, 64), value / 255, np.float32)
    render = Render(np.stack([blank] * 3, axis=2), blank, blank, blank, np.ones_like(blank))
    camera = Camera(64, 48, np.array([[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]]))
    assert np.isnan(correlation(render.image(), camera, render))


def test_what_the_map_does_not_cover_is_not_compared(seen, room_camera) -> None:
    image, render = seen
    uncovered = replace(render, alpha=np.zeros_like(render.alpha))
    assert np.isnan(correlation(image, room_camera, uncovered))
