"""The debug picture: what is drawn where, and words that are never lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.localize.estimate import Estimate, Status, Trace
from gsfeatloc_ros.localize.evidence import Evidence
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.match.base import Matches
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.render.base import Render
from gsfeatloc_ros.ros_io.debug_picture import draw, draw_refused

FAILED = Estimate(Status.FAILED, "0 features in the photo: is it too dark, too bright or out of focus?")


def grey(width: int, height: int, level: int = 128) -> np.ndarray:
    return np.full((height, width, 3), level, np.uint8)


def grey_render(width: int, height: int) -> Render:
    depth = np.ones((height, width), np.float32)
    return Render(np.full((height, width, 3), 0.25, np.float32), depth, depth, depth, depth)


def matches(a: list[list[float]], b: list[list[float]]) -> Matches:
    return Matches(np.array(a, dtype=float), np.array(b, dtype=float), np.ones(len(a)))


def grey_photo(width: int = 640, height: int = 480) -> Photo:
    return Photo(grey(width, height), np.ones((height, width), bool), Camera(width, height, np.eye(3)))


def nothing(estimate: Estimate = FAILED) -> Trace:
    """Nothing was matched with a grey photo."""
    return Trace(estimate, grey_photo())


def localized(correspondences: Matches, width: int = 640, height: int = 480) -> Trace:
    evidence = Evidence(inliers=len(correspondences))
    estimate = Estimate(Status.LOCALIZED, "found", np.eye(4), np.diag([1e-6] * 6), evidence)
    return Trace(estimate, grey_photo(width, height), grey_render(width, height), correspondences)


def badge(picture: np.ndarray) -> tuple[int, int, int]:
    """Colour behind the status: the one that is most frequent in its corner of the band."""
    corner = picture[-202:-162, 14:100].reshape(-1, 3)
    colours, counts = np.unique(corner, axis=0, return_counts=True)
    saturated = colours.max(axis=1).astype(int) - colours.min(axis=1) > 60
    return tuple(colours[saturated][counts[saturated].argmax()].tolist())


def test_nothing_was_matched():
    picture = draw(nothing())
    assert picture.dtype == np.uint8
    assert picture.shape[1:] == (1280, 3)
    np.testing.assert_array_equal(picture[30:480, :640], 128)
    # Black, but for the words that say so.
    assert 0.9 < np.mean(picture[30:480, 640:] == 0) < 1


def test_no_inliers():
    plain = draw(localized(Matches.none()))
    np.testing.assert_array_equal(plain[30:480, :640], 128)
    np.testing.assert_array_equal(plain[30:480, 640:], 64)


@pytest.mark.parametrize("width", [160, 640, 1280])
def test_a_match_has_a_ring_at_both_ends(width: int):
    """Pixel centres are integers, so a pixel p of an image drawn s times as large is at s (p + 0.5) - 0.5."""
    height, scale = 3 * width // 4, 640 / width
    a, b = np.array([0.3, 0.4]) * [width, height], np.array([0.6, 0.8]) * [width, height]
    one = draw(localized(matches([a], [b]), width, height)).astype(int)
    none = draw(localized(Matches.none(), width, height)).astype(int)
    rows, columns = np.nonzero(np.abs(one - none).sum(axis=2)[:480] > 60)
    left, right = scale * (a + 0.5) - 0.5 - 3, scale * (b + 0.5) - 0.5 + [640, 0] + 3
    assert [columns.min(), rows.min()] == pytest.approx(left, abs=1)
    assert [columns.max(), rows.max()] == pytest.approx(right, abs=1)


def test_both_ends_of_a_match_have_its_colour():
    picture = draw(localized(matches([[100, 100], [500, 300]], [[200, 200], [400, 400]]))).astype(int)

    def colour(x: int, y: int) -> np.ndarray:
        patch = picture[y - 4 : y + 5, x - 4 : x + 5].reshape(-1, 3)
        return patch[(patch.max(axis=1) - patch.min(axis=1)).argmax()]

    first, second = (colour(100, 100), colour(840, 200)), (colour(500, 300), colour(1040, 400))
    assert np.abs(first[0] - first[1]).max() < 60
    assert np.abs(second[0] - second[1]).max() < 60
    assert np.abs(first[0] - second[0]).max() > 100


def test_six_hundred_inliers_hide_less_than_a_third():
    rng = np.random.default_rng(0)
    a = rng.uniform(0, [640, 480], (600, 2))
    correspondences = matches(a, a + rng.normal(0, 1, a.shape))
    drawn, plain = (draw(localized(m))[30:480] for m in (correspondences, Matches.none()))
    assert np.mean((drawn != plain).any(axis=2)) < 1 / 3


def test_the_status_has_its_colour():
    red, green, blue = badge(draw(localized(Matches.none())))
    assert green > 1.5 * max(red, blue)
    red, green, blue = badge(draw(replace(nothing(Estimate(Status.REJECTED, "no")), render=grey_render(640, 480))))
    assert red > green > 2 * blue
    for picture in (draw(nothing()), draw_refused(grey(640, 480), "no prior yet")):
        red, green, blue = badge(picture)
        assert red > 2 * max(green, blue)


def test_pictures_of_one_camera_have_one_size():
    pictures = [
        draw(nothing()),
        draw(localized(matches([[1, 2]], [[3, 4]]))),
        draw(nothing(replace(FAILED, reason="word " * 40, milliseconds={"prepare": 2.0, "total": 1234.5}))),
        draw_refused(grey(640, 480), ""),
        draw_refused(grey(1280, 960), "camera_info is for 640x480 but the image is 1280x960"),
    ]
    assert {picture.shape for picture in pictures} == {pictures[0].shape}


def test_a_long_reason_is_written_to_its_end():
    photo = grey(640, 480)
    words = [f"word{number}" for number in range(120)]
    long, longer = (draw_refused(photo, " ".join(chosen)) for chosen in (words, [*words, "end"] + ["more"] * 40))
    assert draw_refused(photo, "short").shape[0] < long.shape[0] < longer.shape[0]
    # What is written of the shorter text stands in the same places: nothing was squeezed, cut or left out.
    np.testing.assert_array_equal(long[480:590, 130:], longer[480:590, 130:])


def test_no_word_is_cut():
    """Words that fill a line to different lengths: each line begins and ends with a gap, never at the margin."""
    for length in (5, 9, 17, 33):
        band = draw_refused(grey(640, 480), " ".join(["m" * length] * 60))[480:]
        assert (band[:, -10:] == band[0, 0]).all()


def test_a_word_wider_than_the_picture_is_broken():
    photo = grey(640, 480)
    broken = draw_refused(photo, "no map at /" + "m" * 400)
    assert broken.shape[0] > draw_refused(photo, "no map at /").shape[0]
    assert (broken[480:, -10:] == broken[480, 0]).all()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 20000), (20000, 1), (480, 640), (3000, 2000)])
def test_photos_of_any_shape(width: int, height: int):
    picture = draw_refused(grey(width, height), "no prior yet")
    assert picture.shape[1:] == (1280, 3)
    assert picture.shape[0] < 1200


def test_the_photo_is_not_drawn_on():
    trace = localized(matches([[100, 100]], [[100, 100]]))
    draw(trace)
    draw_refused(trace.photo.image, "no prior yet")
    assert (trace.photo.image == 128).all()
    assert (trace.render.rgb == 0.25).all()


def test_every_number_of_the_evidence_is_drawn():
    """Fields end before the margin, with all that can be there: evidence, stages and standard deviations."""
    stages = ("prepare", "features", "render", "match", "solve", "track", "verify", "total")
    trace = localized(Matches.none())
    numbers = dict.fromkeys(Evidence().numbers(), -0.999)
    numbers |= {"corners": 800, "matches": 800, "lifted": 800, "inliers": 800, "passes": 20, "views": 1000}
    evidence = Evidence(**numbers | {"deviation": 100.123, "probability_wrong": 1e-10})
    estimate = replace(trace.estimate, evidence=evidence, milliseconds=dict.fromkeys(stages, 12345.0))
    band = draw(replace(trace, estimate=estimate))[480:]
    assert (band[:, -10:] == band[0, 0]).all()
    # In pictures of one size.
    assert band.shape == draw(nothing())[480:].shape
    for name in numbers:
        other = replace(estimate, evidence=replace(evidence, **{name: 3}))
        assert (draw(replace(trace, estimate=other))[480:] != band).any(), name
    other = replace(estimate, covariance=100 * estimate.covariance)
    # The protection level is among the evidence, above the standard deviations.
    rows = slice(480 + 52, 480 + 52 + 3 * 42)
    assert (draw(replace(trace, estimate=other))[rows] != draw(replace(trace, estimate=estimate))[rows]).any()


def test_a_localized_photo_of_the_room(room_map, room_camera, room_photos):
    simulated = room_photos[0]
    localizer = Localizer(create_renderer(room_map), create_matcher("sift"))
    trace = localizer.trace(simulated.image, room_camera, simulated.T_map_camera_prior)
    assert trace.estimate.localized
    picture = draw(trace)
    _, green, _ = badge(picture)
    assert green > 100
    # Photo and render are there behind what is drawn on them.
    for half, image in ((picture[30:480, :640], trace.photo.image), (picture[30:480, 640:], trace.render.image())):
        assert np.mean((half == image[30:]).all(axis=2)) > 0.5
