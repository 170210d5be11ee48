"""What was once believed wrongly, or with too small a covariance, on real photos."""

from __future__ import annotations

import numpy as np
import pytest

from gsfeatloc_ros.common.geometry import moved, rotation_error_deg, translation_error
from gsfeatloc_ros.evaluate.corruptions import corrupt
from gsfeatloc_ros.evaluate.degradations import degrade
from gsfeatloc_ros.evaluate.protocol import PROTOCOLS
from gsfeatloc_ros.evaluate.scene import load_degraded_renderer, load_scene, load_scene_renderer
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.localize.settings import RendererSettings
from gsfeatloc_ros.match import create_matcher

# Of the wrong pose from the true one: translation and rotation vector, map frame.
WRONG = np.array([0.1267, -0.20051, 0.11667, -0.00496, 0.00601, 0.01722])


def test_a_wheel_that_agrees_does_not_hide_the_rest(scenes) -> None:
    """Of the photo a wheel is left, and some of the table: on its spokes a pose agrees that is 1.1 degrees off."""
    scene = load_scene(scenes / "bonsai")
    number, photo = next((n, p) for n, p in enumerate(scene.photos) if p.name == "DSCF5789.jpg")
    image, camera = corrupt("cover-40", scene.read_photo(photo), photo.camera, (102, number))
    prior = moved(photo.T_map_camera, WRONG)
    estimate = Localizer(load_scene_renderer(scene, RendererSettings()), create_matcher("sift")).localize(
        image, camera, prior
    )
    assert estimate.localized, estimate.reason
    assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera) < 0.2
    assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.05


@pytest.mark.parametrize(
    ("scene_name", "photo_name", "corruption", "seed", "says"),
    [
        # The reading itself says so: 9.1 % shorter is what the camera is.
        ("office", "00175.jpg", "focal+10", 305, "the focal length fits 9.1 +- 0.7 % shorter than calibrated"),
        ("office", "00175.jpg", "focal+10", 314, "the focal length fits 9.4 +- 1.2 % shorter than calibrated"),
        ("office", "00183.jpg", "focal+10", 205, "the focal length fits 5.6 +- 2.4 % shorter than calibrated"),
        ("bonsai", "DSCF5813.jpg", "focal-10", 103, "% longer than calibrated: is camera_info of this stream?"),
        ("office", "00175.jpg", "focal+10", 102, "% shorter than calibrated: is camera_info of this stream?"),
        ("office", "00175.jpg", "focal+10", 200, "% shorter than calibrated: is camera_info of this stream?"),
    ],
)
def test_a_part_that_fits_by_a_wrong_focal_length_is_no_answer(
    scenes, scene_name: str, photo_name: str, corruption: str, seed: int, says: str
) -> None:
    """A part of the photo agrees with a pose up to 0.35 radii off, and reads as if the focal length were right."""
    scene = load_scene(scenes / scene_name)
    number, photo = next((n, p) for n, p in enumerate(scene.photos) if p.name == photo_name)
    image, camera = corrupt(corruption, scene.read_photo(photo), photo.camera, (seed, number))
    prior = next(prior for prior in PROTOCOLS["paper"](scene, 1.0, seed) if prior.photo == number)
    localizer = Localizer(load_scene_renderer(scene, RendererSettings()), create_matcher("sift"))
    estimate = localizer.localize(image, camera, prior.T_map_camera, prior.covariance)
    assert not estimate.localized
    assert says in estimate.reason


@pytest.mark.parametrize("photo_name", ["DSCF5797.jpg", "DSCF5805.jpg"])
def test_a_render_beside_the_photo_does_not_speak_for_another_focal_length(scenes, photo_name: str) -> None:
    """From where the last render was fewer corners are found than with a focal length that is 4 % off, but nearer."""
    scene = load_scene(scenes / "bonsai")
    number, photo = next((n, p) for n, p in enumerate(scene.photos) if p.name == photo_name)
    image, camera = corrupt("cover-40", scene.read_photo(photo), photo.camera, (200, number))
    prior = next(prior for prior in PROTOCOLS["paper"](scene, 1.0, 200) if prior.photo == number)
    options = LocalizerOptions(seed=200)
    localizer = Localizer(load_scene_renderer(scene, RendererSettings()), create_matcher("sift"), options)
    estimate = localizer.localize(image, camera, prior.T_map_camera, prior.covariance)
    assert estimate.localized, estimate.reason
    assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera) < 0.2


@pytest.mark.parametrize("corruption", ["motion", "motion-25"])
@pytest.mark.parametrize("mirrored", [True, False])
def test_a_blurred_mirror_image_is_no_photo(scenes, corruption: str, mirrored: bool) -> None:
    """The photo was taken from lego's plane of symmetry: all that tells its mirror image apart is detail."""
    scene = load_scene(scenes / "lego")
    photo = next(photo for photo in scene.photos if photo.name == "test_r_0.png")
    image = scene.read_photo(photo)
    image, camera = corrupt(corruption, np.fliplr(image) if mirrored else image, photo.camera, (300, 0))
    localizer = Localizer(load_scene_renderer(scene, RendererSettings()), create_matcher("sift"))
    estimate = localizer.localize(image, camera, photo.T_map_camera)
    assert estimate.localized is not mirrored
    if mirrored:
        assert "it is wrong with a probability of" in estimate.reason


@pytest.mark.parametrize(("photo_name", "is_flat"), [("00175.jpg", False), ("00183.jpg", True), ("00273.jpg", False)])
def test_a_haze_near_a_wall_lends_it_no_relief(scenes, photo_name: str, is_flat: bool) -> None:
    """Of a wall from the front, whose corners were lifted onto a haze a tenth nearer: up to 7 degrees off.

    One is so flat that without haze it would not show a wrong focal length; nor does it with haze.
    """
    scene = load_scene(scenes / "office")
    number, photo = next((n, p) for n, p in enumerate(scene.photos) if p.name == photo_name)
    renderer = load_degraded_renderer(scene, RendererSettings(), lambda map_: degrade("haze", map_, scene, 203))
    prior = next(prior for prior in PROTOCOLS["paper"](scene, 1.0, 203) if prior.photo == number)
    localizer = Localizer(renderer, create_matcher("sift"), LocalizerOptions(seed=203))
    estimate = localizer.localize(scene.read_photo(photo), photo.camera, prior.T_map_camera, prior.covariance)
    if is_flat:
        assert not estimate.localized
        assert "would not show in this image" in estimate.reason
        return
    assert estimate.localized, estimate.reason
    assert rotation_error_deg(estimate.T_map_camera, photo.T_map_camera) < 0.5
