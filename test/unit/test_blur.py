"""How a photo is blurred, told from a sharp picture of nearly the same view."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsfeatloc_ros.localize.blur import estimate_blur
from gsfeatloc_ros.render import create_renderer


@pytest.fixture(scope="module")
def sharp(room_map, room_camera, room_photos) -> np.ndarray:
    """Brightness of a view of the room."""
    render = create_renderer(room_map).render(room_camera, room_photos[0].T_map_camera)
    return cv2.cvtColor(render.image(), cv2.COLOR_RGB2GRAY)


def moved(image: np.ndarray, length: int, degrees: float) -> np.ndarray:
    """Blur an image by a motion: the mean of shifted copies."""
    turn = np.radians(degrees)
    copies = []
    for step in np.linspace(-length / 2, length / 2, 2 * length + 1):
        shift = np.float32([[1, 0, step * np.cos(turn)], [0, 1, step * np.sin(turn)]])
        copies.append(cv2.warpAffine(image, shift, image.shape[::-1], borderMode=cv2.BORDER_REFLECT))
    return np.mean(copies, axis=0).astype(np.uint8)


def main_direction(kernel: np.ndarray) -> float:
    """Degrees in [0, 180) along which a kernel is longest."""
    y, x = np.indices(kernel.shape) - kernel.shape[0] // 2
    tensor = [[(kernel * x * x).sum(), (kernel * x * y).sum()], [(kernel * x * y).sum(), (kernel * y * y).sum()]]
    longest = np.linalg.eigh(tensor)[1][:, 1]
    return float(np.degrees(np.arctan2(longest[1], longest[0])) % 180)


@pytest.mark.slow
def test_a_sharp_picture_is_not_blurred(sharp) -> None:
    assert estimate_blur(sharp, sharp) is None


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 135.0])
@pytest.mark.parametrize("length", [15, 25])
def test_a_motion_is_found_with_its_direction_and_length(sharp, length: int, degrees: float) -> None:
    blur = estimate_blur(moved(sharp, length, degrees), sharp)
    assert blur.extent == pytest.approx(length, rel=0.35)
    assert abs((main_direction(blur.kernel) - degrees + 90) % 180 - 90) < 10
    assert blur.kernel.sum() == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("degrees", [0.0, 60.0, 135.0])
def test_a_motion_is_seen_in_a_map_that_is_less_sharp_than_the_photo(sharp, degrees: float) -> None:
    soft = cv2.GaussianBlur(sharp, (0, 0), 3.0)
    assert estimate_blur(sharp, soft) is None
    blur = estimate_blur(moved(sharp, 16, degrees), soft)
    assert blur is not None
    assert abs((main_direction(blur.kernel) - degrees + 90) % 180 - 90) < 20


def test_a_render_blurred_by_it_is_like_the_photo(sharp) -> None:
    photo = moved(sharp, 25, 60.0)
    blurred = cv2.filter2D(sharp, -1, estimate_blur(photo, sharp).kernel)
    assert np.abs(blurred.astype(float) - photo).mean() < 0.35 * np.abs(sharp.astype(float) - photo).mean()


def test_a_defocus_is_found(sharp) -> None:
    photo = cv2.GaussianBlur(sharp, (0, 0), 5.0)
    blurred = cv2.filter2D(sharp, -1, estimate_blur(photo, sharp).kernel)
    assert np.abs(blurred.astype(float) - photo).mean() < 0.35 * np.abs(sharp.astype(float) - photo).mean()


@pytest.mark.parametrize("off", [(0, 4), (3, 3), (-6, 5)])
def test_what_is_off_across_a_motion_does_not_make_it_a_defocus(sharp, off: tuple[int, int]) -> None:
    """From a prior the render is not where the photo is: the wider a kernel the more the two would be alike."""
    blur = estimate_blur(moved(sharp, 25, 0.0), np.roll(sharp, off, axis=(1, 0)))
    assert np.count_nonzero(blur.kernel.sum(axis=1)) <= 3
    assert np.count_nonzero(blur.kernel.sum(axis=0)) >= 20


@pytest.mark.parametrize("value", [0, 255])
def test_pictures_of_one_colour_are_no_harm(sharp, value: int) -> None:
    blank = np.full_like(sharp, value)
    for photo, render in ((blank, blank), (sharp, blank)):
        assert estimate_blur(photo, render) is None
    estimate_blur(blank, sharp)  # whatever is said of it
