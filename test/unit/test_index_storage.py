"""View indices in files."""

from __future__ import annotations

import contextlib
import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from view_indices import made_up_index

from gsfeatloc_ros.index import ViewIndex, storage
from gsfeatloc_ros.index.storage import index_path, load_index, save_index

KEY = {"map": [[1000, "abc"]], "matcher": ["sift", ""]}
# Bytes of the line and of the checksum before the header, and of the header's length.
BEFORE_LENGTH, LENGTH = len(b"gsfeatloc_ros view index 3\n") + 32, 4


@pytest.fixture(scope="module")
def index() -> ViewIndex:
    return replace(made_up_index(views=3, features=4, dimension=64).index, look_alikes=np.eye(4)[None])


@pytest.fixture(scope="module")
def saved(index, tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("index") / "map.index"
    save_index(path, index, KEY)
    return path.read_bytes()


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "map.index"


def assert_damaged(path: Path, content: bytes) -> None:
    """That is said, but where the key is damaged and asked for: then the file is of something else."""
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"delete it, and it is made again") as failure:
        load_index(path)
    assert str(path) in str(failure.value)
    assert "\n" not in str(failure.value)
    with contextlib.suppress(ValueError):
        assert load_index(path, KEY) is None


def with_header(saved: bytes, header: bytes) -> bytes:
    """The file with another header, and its length."""
    length = int.from_bytes(saved[BEFORE_LENGTH : BEFORE_LENGTH + LENGTH], "little")
    arrays = saved[BEFORE_LENGTH + LENGTH + length :]
    return saved[:BEFORE_LENGTH] + len(header).to_bytes(LENGTH, "little") + header + arrays


def test_what_was_written_is_read(index, path) -> None:
    save_index(path, index, KEY)
    for read in (load_index(path, KEY), load_index(path)):
        assert read is not None
        for name, array in vars(index).items():
            stored = getattr(read, name)
            assert (stored.dtype, stored.shape) == (array.dtype, array.shape)
            # Centroids are halves in the file.
            np.testing.assert_allclose(stored, array, atol=1e-3 if name == "centroids" else 0)


def test_folders_are_made_and_nothing_else_is_left(index, path) -> None:
    deeper = path.parent / "a" / "b" / path.name
    for _ in range(2):
        save_index(deeper, index, KEY)
    assert os.listdir(deeper.parent) == [path.name]


def test_an_index_that_cannot_be_written_leaves_the_old_one(index, path, monkeypatch) -> None:
    path.write_bytes(b"old")

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(storage.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_index(path, index, KEY)
    assert path.read_bytes() == b"old"
    assert os.listdir(path.parent) == [path.name]


def test_no_file_is_no_index(path) -> None:
    assert load_index(path, KEY) is None
    assert load_index(path / "deeper", KEY) is None


@pytest.mark.parametrize("key", [{}, dict(list(KEY.items())[:1])])
def test_an_index_that_says_more_than_is_asked_for_is_taken(saved, path, key) -> None:
    path.write_bytes(saved)
    assert load_index(path, key) is not None


@pytest.mark.parametrize("key", [{**KEY, "matcher": ["xfeat", ""]}, {"matcher": ["xfeat", ""]}, {**KEY, "more": 1}])
def test_an_index_of_something_else_is_none_of_this(saved, path, key) -> None:
    path.write_bytes(saved)
    assert load_index(path, key) is None


def test_a_folder_cannot_be_read(tmp_path) -> None:
    with pytest.raises(OSError):  # noqa: PT011
        load_index(tmp_path)


def test_what_others_can_have_written_is_not_read(index, path, untrusted) -> None:
    save_index(path, index, KEY)
    says = untrusted(path)
    with pytest.raises(OSError) as refusal:  # noqa: PT011
        load_index(path, KEY)
    assert says in str(refusal.value)
    save_index(path, index, KEY)
    assert load_index(path, KEY) is not None


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_cut_file_is_damaged(saved, path, share: float) -> None:
    assert_damaged(path, saved[: int(share * len(saved))])


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255))
def test_a_file_with_another_byte_is_damaged(saved, path, place: float, bits: int) -> None:
    changed = bytearray(saved)
    changed[int(place * len(saved))] ^= bits
    assert_damaged(path, bytes(changed))


@given(where=st.integers(0, 400), bits=st.integers(1, 255))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_header_with_another_byte_is_damaged(saved, path, where: int, bits: int) -> None:
    changed = bytearray(saved)
    changed[where] ^= bits
    assert_damaged(path, bytes(changed))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(added=st.binary(min_size=1, max_size=20))
def test_a_file_with_more_at_its_end_is_damaged(saved, path, added: bytes) -> None:
    assert_damaged(path, saved + added)


lies = st.one_of(st.integers(-(2**70), 2**70), st.sampled_from([math.inf, math.nan, 1e300, "many", None, [1]]))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(["N", "F", "L", "D", "S"]), lie=lies)
@example(name="N", lie=1_000_000)
@example(name="L", lie=2**31 - 1)
@example(name="D", lie=64)
@example(name="F", lie=math.inf)
def test_no_memory_is_taken_for_sizes_that_the_file_does_not_have(saved, path, name: str, lie) -> None:
    length = int.from_bytes(saved[BEFORE_LENGTH : BEFORE_LENGTH + LENGTH], "little")
    header = json.loads(saved[BEFORE_LENGTH + LENGTH :][:length])
    assume(header["sizes"][name] != lie)
    header["sizes"][name] = lie

    def no_memory(*arguments):
        raise AssertionError(f"memory is taken for {arguments}")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(storage.np, "fromfile", no_memory)
        assert_damaged(path, with_header(saved, json.dumps(header).encode()))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(header=st.one_of(st.binary(max_size=50), st.text(max_size=50).map(str.encode)))
@example(header=b"[" * 60_000)
@example(header=b"{}")
@example(header=b'{"key": 1, "sizes": []}')
def test_a_header_of_anything_is_damaged(saved, path, header: bytes) -> None:
    assert_damaged(path, with_header(saved, header))


def test_a_header_that_claims_to_be_endless_is_damaged(saved, path) -> None:
    assert_damaged(path, saved[:BEFORE_LENGTH] + b"\xff\xff\xff\xff" + saved[BEFORE_LENGTH + LENGTH :])


def test_numbers_that_are_none_are_damaged_even_if_they_were_written(index, path) -> None:
    poses = index.poses.copy()
    poses[1, 0, 3] = np.nan
    save_index(path, ViewIndex(**{**vars(index), "poses": poses}), KEY)
    with pytest.raises(ValueError, match="is damaged"):
        load_index(path)


def test_counts_that_do_not_add_up_are_damaged(index, path) -> None:
    for counts in ([4, 4, 5], [-4, 8, 8]):
        save_index(path, ViewIndex(**{**vars(index), "counts": np.array(counts, np.int32)}), KEY)
        with pytest.raises(ValueError, match="is damaged"):
            load_index(path)


def test_landmarks_that_there_are_none_of_are_damaged(index, path) -> None:
    save_index(path, replace(index, seen=np.where(index.seen == 5, 12, index.seen)), KEY)
    with pytest.raises(ValueError, match="is damaged"):
        load_index(path)


def test_an_index_lies_beside_its_map_or_in_the_users_cache(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    beside = index_path(tmp_path / "map.ply")
    assert beside == tmp_path / "map.ply.gsfeatloc-index"
    monkeypatch.setattr(storage, "can_write", lambda folder: False)
    cached = index_path(tmp_path / "map.ply")
    assert cached.parent == tmp_path / "cache" / "gsfeatloc_ros" / "indices"
    assert cached != index_path(tmp_path / "other" / "map.ply")
    beside.touch()
    assert index_path(tmp_path / "map.ply") == beside
