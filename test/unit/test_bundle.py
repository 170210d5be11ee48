"""Map bundles: made by gsfeatloc prepare, taken wherever a map is."""

from __future__ import annotations

import json
import shutil
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest

from gsfeatloc_ros.align.alignment import write_parameters
from gsfeatloc_ros.index import IndexOptions
from gsfeatloc_ros.index.storage import index_path, load_index
from gsfeatloc_ros.localize.map_index import index_key
from gsfeatloc_ros.localize.settings import MapSettings, MatcherSettings
from gsfeatloc_ros.maps import MapError, load_map
from gsfeatloc_ros.maps.bundle import read_bundle
from gsfeatloc_ros.render.cache import load_prepared, map_content
from gsfeatloc_ros.tools import prepare

PLACED = MapSettings(aligned=True, scale=2.0, translation=(1.0, 2.0, 3.0), rotation=(0.0, 0.0, 0.6, 0.8))
FEW = ["--views", "3", "--skip-inspection"]


@pytest.fixture(scope="module")
def made(tmp_path_factory, room_map_file) -> Path:
    """A bundle, to be copied and not to be changed."""
    folder = tmp_path_factory.mktemp("made")
    write_parameters(folder / "align.yaml", PLACED, ["scale: 2.000 +- 0.001"])
    # As it is typed, with paths from here.
    with chdir(folder):
        assert prepare.main([str(room_map_file), "--align", "align.yaml", "--out", "room", *FEW]) == 0
    return folder / "room"


@pytest.fixture
def bundle(made, tmp_path) -> Path:
    """A copy elsewhere, as on a robot."""
    return shutil.copytree(made, tmp_path / "robot")


def change(bundle: Path, **about) -> None:
    manifest = bundle / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | about))


def test_a_folder_without_a_manifest_is_no_bundle(tmp_path) -> None:
    assert read_bundle(tmp_path) is None
    assert MapSettings(str(tmp_path)).resolved() == MapSettings(str(tmp_path))
    assert MapSettings().resolved() == MapSettings()


def test_a_copy_has_all_that_a_robot_needs(bundle, room_map_file) -> None:
    map_ = MapSettings(str(bundle)).resolved()
    assert (map_.aligned, map_.scale) == (True, 2.0)
    assert (map_.translation, map_.rotation) == (PLACED.translation, PLACED.rotation)
    index = load_index(index_path(bundle), index_key(str(bundle), map_, MatcherSettings(), IndexOptions()))
    assert index is not None
    assert len(index) > 0
    assert "scale: 2.000 +- 0.001" in (bundle / "alignment.yaml").read_text()
    before = sorted(bundle.rglob("*"))
    prepared = load_prepared(bundle, map_.alignment())
    assert sorted(bundle.rglob("*")) == before
    assert prepared.S_map_splat.scale == 2.0
    np.testing.assert_array_equal(load_map(bundle).means, load_map(room_map_file).means)
    assert map_content(bundle) == map_content(room_map_file)


def test_what_is_there_and_fits_is_not_made_again(bundle, room_map_file, tmp_path) -> None:
    write_parameters(tmp_path / "align.yaml", PLACED, ["scale: 2.000 +- 0.001"])
    again = [str(room_map_file), "--align", str(tmp_path / "align.yaml"), "--out", str(bundle), *FEW]
    files = [path for path in bundle.rglob("*") if path.is_file() and path.name != "manifest.json"]
    times = [path.stat().st_mtime_ns for path in files]
    assert prepare.main(again) == 0
    assert [path.stat().st_mtime_ns for path in files] == times
    read_bundle(bundle).map.unlink()
    assert prepare.main(again) == 0
    read_bundle(bundle).check_map()


@pytest.mark.slow
def test_a_bundle_says_what_is_in_its_map(bundle, room_map_file, tmp_path) -> None:
    write_parameters(tmp_path / "align.yaml", PLACED, [])
    again = [str(room_map_file), "--align", str(tmp_path / "align.yaml"), "--out", str(bundle), "--views", "3"]
    assert prepare.main(again) == 0
    found = json.loads((bundle / "inspection.json").read_text())
    # Where the map lies in the bundle: turned about z, twice as large, and 3 higher.
    assert found["upright"]["sure"]
    assert found["upright"]["up"][2] == pytest.approx(1, abs=1e-3)
    assert found["upright"]["floor"] == pytest.approx(3, abs=0.1)
    assert "<html" in (bundle / "inspection.html").read_text()
    assert {"inspection.json", "inspection.html"} <= set(read_bundle(bundle).derived)
    before = (bundle / "inspection.json").stat().st_mtime_ns
    assert prepare.main(again) == 0
    assert (bundle / "inspection.json").stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"scale": 3.0}, "parameter map.scale: 3.0 was given, and the bundle"),
        ({"rotation": (0.0, 0.0, 1.0, 0.0)}, "parameter map.rotation"),
        ({"dataparser_transforms": "x.json"}, "parameter map.dataparser_transforms"),
    ],
)
def test_what_contradicts_the_bundle_is_refused_by_name(made, given, says) -> None:
    assert MapSettings(str(made), scale=2.0).resolved().scale == 2.0
    with pytest.raises(MapError, match=says):
        MapSettings(str(made), **given).resolved()


@pytest.mark.parametrize(
    "content", ["", "{", "[]", "{}", '{"format": "other"}', "\0", "[" * 100_000], ids=lambda text: text[:9]
)
def test_a_damaged_or_foreign_manifest_is_named(tmp_path, content) -> None:
    (tmp_path / "manifest.json").write_text(content)
    with pytest.raises(MapError, match=r"manifest\.json: is (damaged|not of a map bundle)"):
        load_map(tmp_path)


@pytest.mark.parametrize(
    ("about", "says"),
    [
        ({"version": 2}, "version 2"),
        ({"files": None}, "lists no files"),
        ({"files": {"map/room.ply": {"bytes": -1, "sha256": "0" * 64}}}, "no size and SHA-256"),
        ({"map": "map/other.ply"}, "its map is none of"),
        ({"map": []}, "its map is none of"),
        ({"parameters": []}, "no parameters"),
        *(
            ({"files": {name: {"bytes": 1, "sha256": "0" * 64}}}, "not a file in the bundle")
            for name in ("../x", "/etc/passwd", "map/../../x", "map/./x", "a\0", "")
        ),
    ],
)
def test_a_manifest_that_says_what_cannot_be_is_refused(bundle, about, says) -> None:
    change(bundle, **about)
    with pytest.raises(MapError, match=says):
        read_bundle(bundle)


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({"map.scale": "two"}, "map.scale"),
        ({"map.scale": float("nan")}, "map.scale"),
        ({"map.path": "/etc/passwd"}, "has a parameter that no bundle has"),
        ({"localizer.seed": 1}, "has a parameter that no bundle has"),
    ],
)
def test_parameters_of_a_manifest_are_checked(bundle, parameters, says) -> None:
    change(bundle, parameters=parameters)
    with pytest.raises(MapError, match=says):
        MapSettings(str(bundle)).resolved()


@pytest.mark.parametrize("load", [load_map, load_prepared])
def test_a_map_that_was_cut_changed_or_taken_away_is_refused(bundle, load) -> None:
    path = read_bundle(bundle).map
    data = path.read_bytes()
    for spoilt in (data[:-1], data[:-1] + bytes([data[-1] ^ 1])):
        path.write_bytes(spoilt)
        with pytest.raises(MapError, match=r"is not what manifest\.json says"):
            load(bundle)
    path.unlink()
    with pytest.raises(MapError, match="is missing"):
        load(bundle)


def test_a_link_out_of_the_bundle_is_refused(bundle, room_map_file) -> None:
    path = read_bundle(bundle).map
    path.unlink()
    path.symlink_to(room_map_file)
    with pytest.raises(MapError, match="not a file in the bundle"):
        load_map(bundle)


def test_a_changed_alignment_is_refused(bundle) -> None:
    (bundle / "alignment.yaml").write_text("scale: 3.0")
    with pytest.raises(MapError, match=r"alignment\.yaml: is not what"):
        MapSettings(str(bundle)).resolved()


def test_what_prepare_cannot_use_is_said_in_one_line(bundle, room_map_file, tmp_path, capsys) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    (tmp_path / "other.yaml").write_text("/**: {ros__parameters: {localizer: {seed: 1}}}")
    room = str(room_map_file)
    for arguments, says in [
        ([room, "--out", str(tmp_path / "full")], "not empty, and no bundle"),
        ([room, "--out", str(bundle)], "has an alignment, which would be lost"),
        ([room, "--out", str(bundle / "manifest.json")], "is a file"),
        ([room, "--out", str(tmp_path / "new"), "--align", str(tmp_path / "other.yaml")], "localizer.seed"),
        ([room, "--out", str(tmp_path / "new"), "--camera-height", "0.4"], "index.camera_height needs map.aligned"),
        ([str(tmp_path / "nowhere.ply"), "--out", str(tmp_path / "new")], "nowhere.ply: cannot be read"),
    ]:
        assert prepare.main(arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("prepare: ")
        assert says in line
    assert not (tmp_path / "new").exists()
