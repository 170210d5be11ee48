"""Prepared maps in files beside the maps."""

from __future__ import annotations

import json
import logging
import os
import stat
import zlib
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import map_files
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_maps import small_camera

from gsfeatloc_ros.common.geometry import so3_exp
from gsfeatloc_ros.maps import MapError, Similarity, load_map
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.render import StaleMapError, cache, cache_file, create_renderer, prepare_large, stored
from gsfeatloc_ros.render.cache import load_prepared
from gsfeatloc_ros.render.chunks import LOG2_OPACITY, MEAN_X, PreparedMap
from gsfeatloc_ros.render.prepare import prepare
from gsfeatloc_ros.render.stored import Resident, StoredArray
from gsfeatloc_ros.simulate.two_rooms import VIEWS, two_rooms

# Where it begins: behind a line of text, its length and the checksums.
HEADER = len(cache_file.MAGIC) + 4 * (2 + len(cache_file.ARRAYS))
ARRAYS = [field.name for field in fields(PreparedMap) if "ndarray" in str(field.type)]


@pytest.fixture
def map_file(tmp_path) -> Path:
    path = tmp_path / "map.ply"
    write_ply(path, two_rooms(1000))
    return path


@pytest.fixture
def preparations(monkeypatch) -> list[PreparedMap]:
    """The maps that were prepared, not read from a cache, since the test began."""
    done = []

    def counted(gaussian_map):
        done.append(prepare(gaussian_map))
        return done[-1]

    monkeypatch.setattr(cache, "prepare", counted)
    return done


def cache_of(map_path: Path) -> Path:
    return map_path.with_name(map_path.name + ".gsfeatloc-cache")


def assert_same(one: PreparedMap, other: PreparedMap) -> None:
    for name in ARRAYS:
        a, b = getattr(one, name)[:], getattr(other, name)[:]
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        # The bits: of what fills up the last chunk some may be NaN.
        assert a.tobytes() == b.tobytes()
    assert one.antialiased == other.antialiased


def test_second_time_the_map_comes_from_the_cache(map_file, preparations):
    first, second = load_prepared(map_file), load_prepared(map_file)
    assert len(preparations) == 1
    assert_same(first, second)
    assert_same(second, prepare(load_map(map_file)))
    assert sorted(path.name for path in map_file.parent.iterdir()) == ["map.ply", "map.ply.gsfeatloc-cache"]


def test_arrays_from_the_cache_are_like_new_ones(map_file):
    """Numba compiles again for arrays that are not writable or not contiguous."""
    load_prepared(map_file)
    for name in ARRAYS:
        array = getattr(load_prepared(map_file), name)
        assert type(array) is np.ndarray
        assert array.flags.c_contiguous
        assert array.flags.writeable
        assert array.flags.aligned


@pytest.mark.parametrize("antialiased", [False, True])
def test_antialiased_flag_is_kept(tmp_path, antialiased):
    path = tmp_path / "map.ply"
    gaussian_map = two_rooms(300)
    object.__setattr__(gaussian_map, "antialiased", antialiased)
    write_ply(path, gaussian_map)
    assert [load_prepared(path).antialiased for _ in range(2)] == [antialiased] * 2


def test_alignment_is_no_part_of_the_cache(map_file, preparations):
    alignment = Similarity(2.0, so3_exp(np.array([0.1, 0.2, 0.3])), np.ones(3))
    assert load_prepared(map_file).S_map_splat.scale == 1.0
    assert load_prepared(map_file, alignment).S_map_splat.scale == alignment.scale
    assert load_prepared(map_file).S_map_splat.scale == 1.0
    assert len(preparations) == 1


def test_changed_map_is_prepared_again(map_file, preparations):
    load_prepared(map_file)
    write_ply(map_file, two_rooms(1000, seed=1))
    changed = load_prepared(map_file)
    assert len(preparations) == 2
    assert_same(changed, prepare(load_map(map_file)))
    load_prepared(map_file)
    assert len(preparations) == 2


def test_other_map_of_the_same_size_and_time_is_prepared_again(map_file, preparations):
    """As in images of containers, where all files are of one second."""
    times = 10**18, 10**18
    os.utime(map_file, ns=times)
    load_prepared(map_file)
    write_ply(map_file, two_rooms(1000, seed=1))
    os.utime(map_file, ns=times)
    assert_same(load_prepared(map_file), prepare(load_map(map_file)))
    assert len(preparations) == 2


def test_other_version_of_the_code_prepares_again(map_file, preparations, monkeypatch):
    load_prepared(map_file)
    monkeypatch.setattr(cache, "_code", lambda: "other")
    load_prepared(map_file)
    assert len(preparations) == 2


def test_unbundled_sog_is_prepared_again_when_any_of_its_files_changes(tmp_path, preparations):
    folder = tmp_path / "scene"
    folder.mkdir()
    map_files.write_sog(folder, map_files.sample_map(300, sh_degree=1, seed=0), version=2)
    load_prepared(folder)
    load_prepared(folder)
    assert len(preparations) == 1
    assert cache_of(folder).is_file()
    scales = folder / "scales.webp"
    scales.write_bytes((folder / "means_l.webp").read_bytes())
    load_prepared(folder)
    assert len(preparations) == 2


def test_map_named_in_the_working_directory(map_file, preparations, monkeypatch):
    monkeypatch.chdir(map_file.parent)
    load_prepared("map.ply")
    load_prepared(map_file)
    assert len(preparations) == 1


@pytest.mark.parametrize("path", ["nowhere.ply", "", "empty.ply", "/dev/null"])
def test_map_that_cannot_be_read_leaves_no_cache(tmp_path, path):
    (tmp_path / "empty.ply").touch()
    with pytest.raises(MapError):
        load_prepared(tmp_path / path)
    assert not list(tmp_path.rglob("*gsfeatloc-cache*"))
    assert not Path("/dev/null.gsfeatloc-cache").exists()


def test_cache_that_cannot_be_written_is_no_error(map_file, caplog):
    """A folder is in the way, which stops root as well."""
    cache_of(map_file).mkdir()
    with caplog.at_level(logging.DEBUG):
        prepared = load_prepared(map_file)
    assert_same(prepared, prepare(load_map(map_file)))
    levels = [record.levelno for record in caplog.records if record.name == cache.__name__]
    assert levels == [logging.WARNING, logging.DEBUG]
    assert not list(map_file.parent.glob(".*"))


def damaged_copies(content: bytes) -> dict[str, bytes]:
    header = HEADER
    return {
        "empty": b"",
        "of something else": b"ply\nformat ascii 1.0\n" * 50,
        "cut in the header": content[: header + 30],
        "cut in the arrays": content[:-1000],
        "longer": content + b"\0",
        "with a hole": content[:-5000] + bytes(5000),
        "with an endless header": cache_file.MAGIC + b"\xff" * 4 + content[len(cache_file.MAGIC) + 4 :],
        "with a header of lists": content[:header] + b"[" * (len(content) - header),
    }


@pytest.mark.parametrize("kind", damaged_copies(b"{").keys())
def test_damaged_cache_is_said_once_and_replaced(map_file, preparations, caplog, kind):
    expected = load_prepared(map_file)
    path = cache_of(map_file)
    good = path.read_bytes()
    path.write_bytes(damaged_copies(good)[kind])
    caplog.clear()
    assert_same(load_prepared(map_file), expected)
    assert len(preparations) == 2
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert str(path) in caplog.text
    assert path.read_bytes() == good


@pytest.mark.slow
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_flipped_byte_goes_unnoticed(map_file, data):
    expected = load_prepared(map_file)
    path = cache_of(map_file)
    content = bytearray(path.read_bytes())
    # As often in what precedes the arrays as in them.
    places = st.one_of(st.integers(0, 800), st.integers(0, len(content) - 1))
    content[data.draw(places)] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    assert_same(load_prepared(map_file), expected)


def forged(map_path: Path, **lies) -> None:
    """Change what the cache's header says of the map, with a checksum that fits."""
    content = cache_of(map_path).read_bytes()
    start = len(cache_file.MAGIC)
    header = HEADER
    end = header + int.from_bytes(content[start : start + 4], "little")
    values = json.loads(content[header:end])
    encoded = json.dumps(values | {"map": values["map"] | lies}).encode()
    numbers = len(encoded).to_bytes(4, "little") + zlib.crc32(encoded).to_bytes(4, "little")
    cache_of(map_path).write_bytes(content[:start] + numbers + content[start + 8 : header] + encoded + content[end:])


@pytest.mark.parametrize(
    ("lie", "says"),
    [
        ({"leaves": 2**24}, "is truncated"),
        ({"leaves": 10**400}, "is damaged"),
        ({"leaves": -1}, "is damaged"),
        ({"leaves": 1.0}, "is damaged"),
        ({"leaves": None}, "is damaged"),
        ({"sh_coefficients": 9}, "is truncated"),
        ({"sh_coefficients": 0}, "is damaged"),
        ({"sh_coefficients": [16]}, "is damaged"),
        ({"antialiased": 1}, "is damaged"),
        ({"coarser": True}, "is truncated"),
        ({"coarser": 0}, "is damaged"),
        ({"more": 0}, "is damaged"),
        ({"offset": [0, 0]}, "is damaged"),
    ],
)
def test_shapes_that_the_arrays_cannot_have_are_refused_before_memory_is_taken(map_file, caplog, lie, says):
    load_prepared(map_file)
    forged(map_file, **lie)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stored.np, "empty", lambda *arguments: pytest.fail("memory is taken"))
        with cache_of(map_file).open("rb") as stream, pytest.raises(cache_file.CacheError, match=says):
            cache_file.read(stream, cache_origin(map_file))
    load_prepared(map_file)
    assert says in caplog.text


def cache_origin(map_path: Path) -> dict:
    text = cache_of(map_path).read_bytes().decode("latin-1")
    return json.JSONDecoder().raw_decode(text, HEADER)[0]["origin"]


@pytest.mark.parametrize(
    ("array", "where", "value"),
    [
        ("gaussians", np.s_[0, MEAN_X, 3], np.nan),
        ("gaussians", np.s_[0, MEAN_X, 3], np.inf),
        ("gaussians", np.s_[0, LOG2_OPACITY, 3], 2.1),
        ("gaussians", np.s_[0, LOG2_OPACITY, 3], np.nan),
        ("sh", np.s_[0, 0, 3], np.inf),
        ("sh", np.s_[0, 0, 3], np.nan),
    ],
)
def test_values_that_no_map_gives_are_damage(map_file, caplog, preparations, array, where, value):
    """Even with a checksum that fits."""
    prepared = load_prepared(map_file)
    origin = cache_origin(map_file)
    getattr(prepared, array)[where] = value
    with cache_of(map_file).open("w+b") as stream:
        cache_file.write(stream, prepared, origin)
    load_prepared(map_file)
    assert "is damaged" in caplog.text
    assert len(preparations) == 2


def moved(map_path: Path) -> None:
    """Move the Gaussians in the cache, with a checksum that fits: it would be believed."""
    prepared = load_prepared(map_path)
    prepared.gaussians[:, MEAN_X] += 1.0
    origin = cache_origin(map_path)
    with cache_of(map_path).open("w+b") as stream:
        cache_file.write(stream, prepared, origin)


def test_a_cache_that_others_can_have_written_is_not_believed(map_file, caplog, preparations, untrusted):
    """As who owns it, its mode or its kind says; and it is replaced."""
    moved(map_file)
    says = untrusted(cache_of(map_file))
    assert_same(load_prepared(map_file), prepare(load_map(map_file)))
    assert len(preparations) == 2
    assert says in caplog.text
    load_prepared(map_file)
    assert len(preparations) == 2
    assert stat.S_IMODE(cache_of(map_file).lstat().st_mode) == 0o644


def large_from_file(map_path: Path) -> PreparedMap:
    """The map, as if it were a large one, from its cache: its Gaussians stay there."""
    with cache_of(map_path).open("w+b") as stream:
        cache_file.write(stream, prepare(load_map(map_path), large=100), {})
    with cache_of(map_path).open("rb") as stream:
        found = cache_file.read(stream, {}, large=100)
    assert found is not None
    return found


def test_the_gaussians_of_a_large_map_stay_in_the_file(map_file):
    prepared, large = prepare(load_map(map_file), large=100), large_from_file(map_file)
    assert_same(large, prepared)
    assert isinstance(large.gaussians, StoredArray)
    assert isinstance(large.sh, StoredArray)
    assert large.leaves == prepared.leaves < len(prepared.sizes)
    np.testing.assert_array_equal(large.unpacked(1).sh, prepared.unpacked(1).sh)
    np.testing.assert_array_equal(large.solid_points(50), prepared.solid_points(50))


@pytest.mark.parametrize("room", [3, 4, 100])
def test_chunks_that_were_read_are_drawn_as_if_all_were_in_memory(map_file, monkeypatch, room: int):
    """In whatever order views come, and however few chunks there is room for."""
    monkeypatch.setattr(stored, "MAX_CHUNKS", room)
    prepared, from_file = prepare(load_map(map_file), large=100), large_from_file(map_file)
    resident, rng = Resident(from_file), np.random.default_rng(0)
    assert len(resident.gaussians) == min(room, len(prepared.sizes))
    for _ in range(30):
        count = rng.integers(min(room, len(prepared.sizes)) + 1)
        chunks = np.sort(rng.choice(len(prepared.sizes), count, replace=False))
        slots = resident.slots(chunks)
        assert len(set(slots)) == count
        assert resident.gaussians[slots].tobytes() == prepared.gaussians[chunks].tobytes()
        assert resident.sh[slots].tobytes() == prepared.sh[chunks].tobytes()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda path: os.truncate(path, path.stat().st_size // 2), "was changed"),
        (lambda path: os.truncate(path, 0), "was cut short"),
        (lambda path: path.write_bytes(path.read_bytes()), "was changed"),
        (lambda path: path.write_bytes(bytes(path.stat().st_size)), "was changed"),
    ],
    ids=["cut short", "emptied", "written again", "overwritten"],
)
def test_a_large_map_whose_file_is_changed_in_place_is_refused(map_file, change, says: str):
    """Were it mapped into memory, the process would end."""
    renderer = create_renderer(large_from_file(map_file), "cpu")
    change(cache_of(map_file))
    for _ in range(2):
        with pytest.raises(StaleMapError, match=f"{cache_of(map_file).name}: {says}"):
            renderer.render(small_camera(), VIEWS["everything"])


@pytest.mark.parametrize("change", [Path.unlink, lambda path: path.rename(path.with_name("other"))])
def test_a_large_map_whose_file_is_removed_or_replaced_is_drawn_all_the_same(map_file, change):
    whole = create_renderer(prepare(load_map(map_file), large=100), "cpu")
    renderer = create_renderer(large_from_file(map_file), "cpu")
    change(cache_of(map_file))
    cache_of(map_file).write_bytes(b"another")
    a, b = (drawn.render(small_camera(), VIEWS["everything"]) for drawn in (whole, renderer))
    np.testing.assert_array_equal(a.rgb, b.rgb)


def test_a_large_map_of_one_level_is_damaged(map_file):
    """A view of it might be of more chunks than there is room for."""
    with cache_of(map_file).open("w+b") as stream:
        cache_file.write(stream, prepare(load_map(map_file)), {})
    with cache_of(map_file).open("rb") as stream, pytest.raises(cache_file.CacheError, match="is damaged"):
        cache_file.read(stream, {}, large=100)


def test_no_flipped_byte_of_a_large_map_goes_unnoticed(map_file):
    with cache_of(map_file).open("w+b") as stream:
        cache_file.write(stream, prepare(load_map(map_file), large=100), {})
    content = cache_of(map_file).read_bytes()
    for place in np.random.default_rng(0).integers(len(cache_file.MAGIC), len(content), 50):
        changed = bytearray(content)
        changed[place] ^= 1
        cache_of(map_file).write_bytes(changed)
        with cache_of(map_file).open("rb") as stream, pytest.raises(cache_file.CacheError):
            cache_file.read(stream, {}, large=100)


@pytest.fixture
def all_are_large(monkeypatch) -> None:
    """Maps of more than 500 Gaussians, in buckets of a few."""
    monkeypatch.setattr(cache, "LARGE_MAP", 500)
    monkeypatch.setattr(prepare_large, "_BUCKET_BYTES", 20_000)


@pytest.mark.parametrize("sh_degree", [0, 3])
@pytest.mark.usefixtures("all_are_large")
def test_a_large_map_prepared_on_disk_is_the_same_as_one_prepared_in_memory(tmp_path, sh_degree: int, preparations):
    gaussian_map = map_files.sample_map(3000, sh_degree, seed=0)
    path = tmp_path / "map.ply"
    write_ply(path, replace(gaussian_map, opacities=np.maximum(gaussian_map.opacities, 0.01), antialiased=True))
    on_disk = load_prepared(path)
    assert not preparations
    assert sorted(file.name for file in tmp_path.iterdir()) == ["map.ply", "map.ply.gsfeatloc-cache"]
    in_memory = prepare(load_map(path), large=500)
    assert_same(on_disk, in_memory)
    assert on_disk.reading == in_memory.reading
    assert on_disk.leaves < len(on_disk.sizes)


@pytest.mark.usefixtures("all_are_large")
def test_what_cannot_be_seen_of_a_large_map_is_left_out(tmp_path):
    gaussian_map = map_files.sample_map(3000, 0, seed=0)
    path = tmp_path / "map.ply"
    write_ply(path, replace(gaussian_map, opacities=np.where(np.arange(3000) % 3, gaussian_map.opacities, 0.0)))
    loaded = load_map(path)
    assert load_prepared(path).unpacked(0).means.shape == (np.count_nonzero(loaded.opacities >= 1 / 255), 3)
    write_ply(path, replace(gaussian_map, opacities=np.zeros(3000, np.float32)))
    with pytest.raises(MapError, match="nothing in it can be seen"):
        load_prepared(path)


@pytest.mark.usefixtures("all_are_large")
def test_a_large_map_whose_cache_cannot_be_written_is_prepared_in_memory(map_file, caplog):
    cache_of(map_file).mkdir()
    assert_same(load_prepared(map_file), prepare(load_map(map_file)))
    assert "the map is prepared in memory" in caplog.text
    assert not list(map_file.parent.glob(".*"))


@pytest.mark.usefixtures("all_are_large")
def test_a_large_map_for_which_there_is_no_disk_is_refused(map_file, monkeypatch):
    monkeypatch.setattr(prepare_large.shutil, "disk_usage", lambda folder: SimpleNamespace(free=1000))
    with pytest.raises(MapError, match="make room there"):
        load_prepared(map_file)
    assert [file.name for file in map_file.parent.iterdir()] == ["map.ply"]


def test_content_is_that_of_a_copy_and_not_of_another_map(map_file, tmp_path) -> None:
    copy, other = tmp_path / "copy.ply", tmp_path / "other.ply"
    copy.write_bytes(map_file.read_bytes())
    write_ply(other, two_rooms(1000, seed=1))
    assert cache.map_content(map_file) == cache.map_content(copy)
    assert cache.map_content(map_file) != cache.map_content(other)


@pytest.mark.parametrize("name", ["map.ply", "a/map.ply", "meta.json", "."])
def test_nothing_has_no_content(tmp_path, name: str) -> None:
    with pytest.raises(MapError, match="cannot be read"):
        cache.map_content(tmp_path / "empty" / name)
