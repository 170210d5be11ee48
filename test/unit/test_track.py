"""The photo without distortion, and its corners followed into renders."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import photo_of, smooth_noise

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert, make_pose, so3_exp, transform
from gsfeatloc_ros.common.local_structure import local_structure
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.match.track import CornerTracker, Follower
from gsfeatloc_ros.match.track_gpu import GpuCornerTracker
from gsfeatloc_ros.render import create_renderer

# What both trackers must do; that for GPUs here on torch's CPU.
both_trackers = pytest.mark.parametrize(
    "tracker_of",
    [
        pytest.param(CornerTracker, id="for CPUs"),
        pytest.param(partial(GpuCornerTracker, device="cpu"), id="for GPUs", marks=pytest.mark.slow),
    ],
)
CAMERA = Camera(160, 120, np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]]))


@both_trackers
@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), dx=st.floats(-6, 6), dy=st.floats(-6, 6))
def test_corners_of_a_moved_picture_are_found_to_a_tenth_of_a_pixel(
    tracker_of, seed: int, dx: float, dy: float
) -> None:
    image = smooth_noise(seed)
    moved = cv2.warpAffine(image, np.array([[1, 0, dx], [0, 1, dy]]), (160, 120), flags=cv2.INTER_CUBIC)
    matches = tracker_of(photo_of(image)).track(moved)
    assert len(matches) > 30
    assert np.median(np.linalg.norm(matches.b - matches.a - [dx, dy], axis=1)) < 0.1


@both_trackers
def test_corners_are_found_in_renders_near_the_photo(tracker_of, room_map, room_camera, room_photos) -> None:
    """The truth is the geometry: the corner's point of the room, seen from the other pose."""
    simulated = room_photos[0]
    photo = Photo.undistorted(simulated.image, room_camera, 640)
    near = simulated.T_map_camera @ make_pose(so3_exp(np.radians([0.4, -0.5, 0.3])), np.array([0.02, 0.01, -0.01]))
    renderer = create_renderer(room_map, "cpu")
    matches = tracker_of(photo).track(renderer.render(photo.camera, near).image())
    assert len(matches) > 100
    columns, rows = np.rint(matches.a).astype(int).T
    depth = renderer.render(photo.camera, simulated.T_map_camera).median_depth[rows, columns].astype(np.float64)
    points = transform(invert(near) @ simulated.T_map_camera, photo.camera.rays(matches.a) * depth[:, None])
    errors = np.linalg.norm(photo.camera.project(points) - matches.b, axis=1)
    assert np.nanmedian(errors) < 1.0  # the map's discs are not quite where the texture is
    assert np.nanmean(errors < 3) > 0.85


@both_trackers
@pytest.mark.parametrize(("gain", "least", "error"), [(0.4, 0.4, 0.5), (0.7, 0.7, 0.2), (1.3, 0.8, 0.2)])
def test_todays_light_does_not_count(tracker_of, gain: float, least: float, error: float) -> None:
    image = smooth_noise(3)
    ramp = np.linspace(0.6, 1.0, 160)[None, :, None]
    lit = np.clip(gain * ramp * image, 0, 255).astype(np.uint8)
    matches = tracker_of(photo_of(image)).track(lit)
    assert len(matches) > least * len(tracker_of(photo_of(image)).corners)
    assert np.median(np.linalg.norm(matches.b - matches.a, axis=1)) < error


@both_trackers
def test_what_is_not_there_is_not_found(tracker_of) -> None:
    tracker = tracker_of(photo_of(smooth_noise(1)))
    assert len(tracker.track(smooth_noise(2))) < 0.2 * len(tracker.corners)


@both_trackers
@pytest.mark.parametrize("value", [0, 128, 255])
def test_blank_pictures_have_no_corners(tracker_of, value: int) -> None:
    blank = np.full((120, 160, 3), value, np.uint8)
    tracker = tracker_of(photo_of(blank))
    assert len(tracker.corners) == 0
    assert len(tracker.track(smooth_noise(0))) == 0
    textured = tracker_of(photo_of(smooth_noise(0)))
    assert len(textured.corners) > 50
    # In what is blank nothing can be found again.
    assert len(textured.track(blank)) == 0


@both_trackers
def test_the_border_of_what_the_lens_saw_is_no_corner(tracker_of) -> None:
    pincushion = Camera(160, 120, CAMERA.K, np.array([0.9, 0.0, 0.0, 0.0]))
    photo = Photo.undistorted(np.full((120, 160, 3), 200, np.uint8), pincushion, 160)
    assert 0.1 < photo.seen.mean() < 0.95
    assert (photo.image[~photo.seen] < 200).any()
    assert len(tracker_of(photo).corners) == 0


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_a_photo_loses_its_distortion_and_its_size_once(model: str) -> None:
    camera = Camera(160, 120, CAMERA.K, np.array([-0.2, 0.05, 0.0, 0.0]), model)
    photo = Photo.undistorted(smooth_noise(0), camera, 80)
    assert photo.image.shape == (60, 80, 3)
    assert photo.seen.shape == photo.gray().shape == (60, 80)
    assert not photo.camera.distorted
    np.testing.assert_allclose(photo.camera.K, camera.limited(80).K)
    smaller = photo.limited(40)
    assert smaller.image.shape == (30, 40, 3)
    assert smaller.seen.shape == (30, 40)
    assert (smaller.camera.width, smaller.camera.height) == (40, 30)


def test_the_mirror_image_is_what_the_camera_sees_of_the_mirrored_world() -> None:
    photo = Photo.undistorted(smooth_noise(0), replace(CAMERA, readout=np.ones(6)), 160)
    mirror = photo.mirrored()
    points = np.array([[0.3, -0.2, 2.0], [-0.1, 0.2, 3.0]])
    x, y = photo.camera.project(points).T
    np.testing.assert_allclose(mirror.camera.project(points * [-1, 1, 1]), np.column_stack([159 - x, y]))
    np.testing.assert_array_equal(mirror.image[5, 159 - 30], photo.image[5, 30])
    assert mirror.camera.readout is None
    np.testing.assert_array_equal(mirror.mirrored().image, photo.image)


@given(gain=st.floats(0.5, 1.0), offset=st.floats(0, 50))
def test_structure_does_not_know_brightness_and_contrast(gain: float, offset: float) -> None:
    gray = np.clip(smooth_noise(5)[..., 0] * 0.7 + 20, 0, 255).astype(np.uint8)
    changed = np.rint(gain * gray + offset).astype(np.uint8)
    a, b = (local_structure(image, 6.0, 2.0)[0] for image in (gray, changed))
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.99


def test_only_what_is_worth_it_is_looked_for() -> None:
    image = smooth_noise(5)
    tracker = CornerTracker(photo_of(image))
    matches = tracker.track(image, lambda pixels: pixels[:, 0] < 80)
    assert 0 < len(matches) < len(tracker.track(image))
    assert (matches.a[:, 0] < 80).all()
    assert (tracker.track_back(image, lambda pixels: pixels[:, 1] < 60).b[:, 1] < 60).all()
    assert len(tracker.track(image, lambda pixels: np.zeros(len(pixels), bool))) == 0


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), dx=st.floats(-6, 6), dy=st.floats(-6, 6))
def test_pixels_of_a_moved_picture_are_followed_each_in_its_place(seed: int, dx: float, dy: float) -> None:
    image = smooth_noise(seed)
    moved = cv2.warpAffine(image, np.array([[1, 0, dx], [0, 1, dy]]), (160, 120), flags=cv2.INTER_CUBIC)
    pixels = np.random.default_rng(seed).uniform([30, 30], [130, 90], (50, 2))
    followed = Follower(image, moved).follow(pixels)
    assert followed.shape == (50, 2)
    found = np.isfinite(followed).all(axis=1)
    assert found.mean() > 0.8
    assert np.median(np.linalg.norm(followed - pixels - [dx, dy], axis=1)[found]) < 0.1


def test_what_cannot_be_followed_is_said_to_be_nowhere() -> None:
    image, pixels = smooth_noise(1), np.array([[40.0, 40.0], [80.0, 60.0]])
    assert np.isnan(Follower(image, np.full_like(image, 128)).follow(pixels)).all()
    assert Follower(image, image).follow(np.empty((0, 2))).shape == (0, 2)
