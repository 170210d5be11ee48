"""Matchers on images whose displacement is known, and on images of nothing."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
import torch
from kornia.color import rgb_to_grayscale
from pictures import rectangles, shifted
from random_weights import WRITERS

from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.match import MATCHERS, Features, create_matcher
from gsfeatloc_ros.match.nearest import match_mutual
from gsfeatloc_ros.match.peaks import centroid, find_peaks, fit_quadratic
from gsfeatloc_ros.match.tensor import to_tensor

# Trained matchers, with the error of a shift in pixels that they may have: twice what was measured. XFeat's keypoints
# keep a pull towards whole pixels.
TOLERANCES = {
    "sift": 0.1,
    "xfeat": 0.5,
    "xfeat-lighterglue": 0.5,
    "aliked-lightglue": 0.1,
    "disk-lightglue": 0.1,
}


# The networks are tested too, but not by `make unit`.
QUICK = ("sift",)


def each(names: Iterable[str]) -> list:
    """Return the parameters for matchers, which are slow but for QUICK ones."""
    return [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.fixture(scope="module")
def create(tmp_path_factory):
    """Makes matchers by name, with random weights where there are no others."""
    torch.manual_seed(0)
    weights = {name: str(write(tmp_path_factory.mktemp(name))) for name, write in WRITERS.items()}
    return lambda name, **options: create_matcher(name, weights=weights.get(name, ""), **options)


@pytest.fixture(scope="module", params=each(MATCHERS))
def matcher(request, create):
    return create(request.param)


@pytest.fixture(scope="module", params=each(TOLERANCES))
def trained(request):
    return request.param, create_matcher(request.param)


def test_every_matcher_is_tested() -> None:
    assert {*TOLERANCES, *WRITERS} == set(MATCHERS)


# Trained networks


@pytest.mark.parametrize("size", [(240, 320), (213, 317)], ids=["multiple of 16", "odd"])
def test_finds_a_subpixel_shift(trained, size) -> None:
    name, matcher = trained
    image = rectangles(*size)
    a, b = matcher.features(image), matcher.features(shifted(image, 3.4, -2.3))
    matches = matcher.match(a, b)
    assert len(matches) > 50
    np.testing.assert_allclose(np.median(matches.b - matches.a, axis=0), [3.4, -2.3], atol=TOLERANCES[name])
    assert (np.abs(matches.b - matches.a - [3.4, -2.3]).max(axis=1) < 2).mean() > 0.6


def test_keypoints_are_inside_the_image_with_unit_descriptors(trained) -> None:
    features = trained[1].features(rectangles(101, 203))
    assert len(features) > 0
    assert features.keypoints.shape == (len(features), 2)
    keypoints = to_host(features.keypoints)
    assert (keypoints >= -0.5).all()
    assert (keypoints <= [202.5, 100.5]).all()
    np.testing.assert_allclose(np.linalg.norm(to_host(features.descriptors), axis=1), 1.0, atol=1e-4)


@pytest.mark.parametrize("value", [0, 255])
def test_an_image_of_nothing_has_no_features(trained, value: int) -> None:
    assert len(trained[1].features(np.full((120, 160, 3), value, np.uint8))) == 0


# All networks, trained or not


def test_matches_are_pixels_of_the_two_images_with_a_score(matcher) -> None:
    a, b = (matcher.features(rectangles(*size)) for size in [(101, 203), (64, 96)])
    for matches in (matcher.match(a, b), matcher.match(a, a), matcher.match(a, a, same_way_up=True)):
        assert matches.a.shape == matches.b.shape == (len(matches), 2)
        assert matches.a.dtype == matches.b.dtype == matches.scores.dtype == np.float64
        assert ((matches.scores >= 0) & (matches.scores <= 1)).all()
        assert ((matches.a >= -0.5) & (matches.a <= [202.5, 100.5])).all()


def test_no_features_have_no_matches(matcher) -> None:
    # Of one pixel no network makes anything.
    nothing, something = matcher.features(np.zeros((1, 1, 3), np.uint8)), matcher.features(rectangles(120, 160))
    assert len(nothing) == 0
    assert len(something) > 0
    for a, b in ((nothing, something), (something, nothing), (nothing, nothing)):
        matches = matcher.match(a, b)
        assert len(matches) == 0
        assert matches.a.shape == matches.b.shape == (0, 2)


@pytest.mark.parametrize("size", [(5, 7), (31, 33)])
def test_tiny_images_do_no_harm(matcher, size) -> None:
    features = matcher.features(rectangles(64, 64)[: size[0], : size[1]].copy())
    assert len(matcher.match(features, features)) <= len(features)


@pytest.mark.parametrize("name", each(MATCHERS))
def test_max_features_is_kept(create, name) -> None:
    matcher = create(name, max_features=50)
    features = matcher.features(rectangles(240, 320))
    assert len(matcher.match(features, features)) <= 51
    if name != "loftr":  # which has no keypoints
        assert 0 < len(features) <= 51


@pytest.mark.parametrize("name", each(["superpoint-superglue", "superpoint-lightglue"]))
def test_superpoint_matches_are_those_of_the_whole_model(create, monkeypatch, name) -> None:
    """The model's own forward(), which takes both images at once and leaves keypoints on whole pixels, is the judge."""
    monkeypatch.setattr("gsfeatloc_ros.match.superpoint.centroid", lambda peaks, heatmap: peaks.float())
    matcher = create(name, max_features=100)
    image = rectangles(96, 128)
    for images, least in (([image, image], 5), ([image, shifted(image, 5, 8)], 1)):
        matches = matcher.match(*map(matcher.features, images))
        with torch.inference_mode():
            grays = [rgb_to_grayscale(to_tensor(image, "cpu"))[0] for image in images]
            whole = matcher._network(torch.stack(grays)[None])
        partners = whole.matches.reshape(2, -1)[0].numpy()
        a, b = (whole.keypoints[0] * torch.tensor([128, 96])).double().numpy()
        np.testing.assert_allclose(matches.a, a[partners >= 0], atol=1e-4)
        np.testing.assert_allclose(matches.b, b[partners[partners >= 0]], atol=1e-4)
        assert len(matches) >= least


@pytest.mark.slow
def test_loftr_matches_cells_of_eight_pixels_in_colmap_s_convention(create) -> None:
    matcher = create("loftr")
    # Untrained it is confident of nothing.
    matcher._loftr.coarse_matching.thr = 0.0
    features = matcher.features(rectangles(96, 128))
    assert len(features) == 12 * 16
    matches = matcher.match(features, features)
    assert len(matches) > 5
    np.testing.assert_allclose((matches.a + 0.5) % 8, 0.0)
    assert (np.diff(matches.scores) <= 0).all()


# Peaks


def bump(center: tuple[float, float]) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(11.0), torch.arange(13.0), indexing="ij")
    return -((x - center[0]) ** 2 + (x - center[0]) * (y - center[1]) / 2 + 2 * (y - center[1]) ** 2) / 3


@pytest.mark.parametrize("center", [(6.0, 5.0), (6.3, 4.8), (5.6, 5.4)])
def test_the_peak_of_a_quadratic_is_found_exactly(center) -> None:
    heatmap = bump(center)
    peaks = find_peaks(heatmap, -1.0, max_peaks=5)
    assert peaks.tolist() == [[round(center[0]), round(center[1])]]
    np.testing.assert_allclose(fit_quadratic(peaks, heatmap)[0], center, atol=1e-5)


def test_the_highest_peaks_come_first_and_low_ones_not_at_all() -> None:
    heatmap = torch.zeros(20, 30)
    heatmap[5, 10], heatmap[12, 20], heatmap[14, 4] = 0.5, 0.9, 0.1
    assert find_peaks(heatmap, 0.2, max_peaks=5).tolist() == [[20, 12], [10, 5]]
    assert find_peaks(heatmap, 0.2, max_peaks=1).tolist() == [[20, 12]]
    assert find_peaks(heatmap, 1.0, max_peaks=5).shape == (0, 2)


def test_a_centroid_is_the_mean_of_the_window() -> None:
    heatmap = torch.zeros(9, 9)
    heatmap[4, 4], heatmap[4, 5], heatmap[5, 4] = 2.0, 1.0, 1.0
    np.testing.assert_allclose(centroid(torch.tensor([[4, 4]]), heatmap), [[4.25, 4.25]])


# Nearest neighbours


def described(descriptors: np.ndarray, array=np.asarray, angles: np.ndarray | None = None) -> Features:
    """Features with these descriptors, scaled to unit length, whose keypoints' x is their number."""
    descriptors = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    keypoints = np.column_stack([np.arange(len(descriptors)), np.zeros(len(descriptors))])
    parts = (array(part.astype(np.float32)) for part in (keypoints, descriptors, np.ones(len(descriptors))))
    return Features(*parts, angles=None if angles is None else array(angles.astype(np.float32)))


@pytest.mark.parametrize("max_turn", [np.pi, 1.0])
@pytest.mark.parametrize("array", [np.asarray, torch.from_numpy])
def test_mutual_matching_equals_the_definition(array, max_turn) -> None:
    rng = np.random.default_rng(0)
    # More than once around: angles that differ by a whole turn are the same.
    first, second = (described(rng.normal(size=(n, 8)), array, rng.uniform(-7, 7, n)) for n in (60, 80))
    a, b = (to_host(features.descriptors) for features in (first, second))
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    turns = to_host(first.angles)[:, None] - to_host(second.angles)
    distance[np.abs(np.arctan2(np.sin(turns), np.cos(turns))) > max_turn] = np.inf
    expected = []
    for i in range(len(a)):
        nearest, runner_up = np.sort(distance[i])[:2]
        j = int(distance[i].argmin())
        if distance[:, j].argmin() == i and nearest < 0.9 * runner_up and 1 - nearest**2 / 2 >= 0.3:
            expected.append((i, j))
    matches = match_mutual(first, second, min_similarity=0.3, max_ratio=0.9, max_turn=max_turn)
    assert len(expected) > 3
    assert list(zip(matches.a[:, 0], matches.b[:, 0], strict=True)) == expected
    np.testing.assert_allclose(matches.scores, [a[i] @ b[j] for i, j in expected], rtol=1e-5)


@pytest.mark.parametrize("array", [np.asarray, torch.from_numpy])
def test_features_that_are_all_turned_too_far_match_nothing(array) -> None:
    same = np.random.default_rng(0).normal(size=(20, 8))
    first, second = (described(same, array, np.full(20, angle)) for angle in (0.0, 3.0))
    assert len(match_mutual(first, second)) == 20
    assert len(match_mutual(first, second, max_turn=2.9)) == 0
    assert len(match_mutual(first, second, max_turn=3.1)) == 20


@pytest.mark.parametrize("array", [np.asarray, torch.from_numpy])
def test_a_single_feature_has_no_rival(array) -> None:
    one, many = (described(np.random.default_rng(0).normal(size=(n, 8)), array) for n in (1, 20))
    assert len(match_mutual(many, one, max_ratio=0.8)) == 1
    assert len(match_mutual(one, one, max_ratio=0.8)) == 1


def test_an_unknown_matcher_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="'surf' is not one of"):
        create_matcher("surf")
