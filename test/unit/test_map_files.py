"""Maps as people bring them: what a file says is used or refused by its name, and files of others are named."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from map_files import (
    ARRAYS,
    sample_map,
    write_gsplat_png,
    write_sog,
    write_splat,
    write_spz,
    write_streamed_sog,
)
from plyfile import PlyData, PlyElement
from view_indices import made_up_index

from gsfeatloc_ros.common.geometry import make_pose
from gsfeatloc_ros.index.storage import save_index
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.localize.options import LocalizerOptions
from gsfeatloc_ros.maps import GaussianMap, MapError, ReadOptions, Similarity, load_map
from gsfeatloc_ros.maps.harmonics import harmonics
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.match import create_matcher
from gsfeatloc_ros.render import create_renderer
from gsfeatloc_ros.render.cache import load_prepared


def vertices(gaussian_map: GaussianMap, path: Path) -> np.ndarray:
    """Return the rows of a map as the INRIA trainer stores them."""
    write_ply(path, gaussian_map)
    return PlyData.read(str(path))["vertex"].data


def save(path: Path, rows: np.ndarray, comments: tuple[str, ...] = (), **columns: np.ndarray) -> Path:
    """Write rows as a .ply, with `columns` added or in place of those of the same name."""
    kept = [name for name in rows.dtype.names if name not in columns]
    values = {name: rows[name] for name in kept} | columns
    out = np.empty(len(rows), dtype=[(name, column.dtype) for name, column in values.items()])
    for name, column in values.items():
        out[name] = column
    PlyData([PlyElement.describe(out, "vertex")], byte_order="<", comments=list(comments)).write(str(path))
    return path


def notes(gaussian_map: GaussianMap) -> str:
    return "; ".join(gaussian_map.reading.notes)


@pytest.fixture
def rows(tmp_path) -> np.ndarray:
    """Return 500 rows of the INRIA layout."""
    return vertices(sample_map(500, 1, seed=0), tmp_path / "plain.ply")


# What files declare and leave open


def test_the_3d_filter_of_mip_splatting_is_fused(tmp_path, rows):
    widths = np.random.default_rng(1).uniform(0.001, 0.5, 500)
    plain = load_map(save(tmp_path / "plain.ply", rows))
    fused = load_map(save(tmp_path / "map.ply", rows, filter_3D=widths.astype("f4")))
    for i in (0, 17, 499):
        squares = [float(s) ** 2 for s in plain.scales[i]]
        wider = [s + widths[i] ** 2 for s in squares]
        np.testing.assert_allclose(fused.scales[i], np.sqrt(wider), rtol=1e-5)
        ratio = np.sqrt(np.prod(squares) / np.prod(wider))
        np.testing.assert_allclose(fused.opacities[i], plain.opacities[i] * ratio, rtol=1e-4)
    assert "filter_3D" in notes(fused)


@pytest.mark.parametrize(
    ("comment", "option", "antialiased", "note"),
    [
        (None, "auto", False, "does not say"),
        (None, "true", True, ""),
        (None, "false", False, ""),
        ("SplatRenderMode: mip", "auto", True, ""),
        ("SplatRenderMode: mip", "false", False, "says otherwise"),
        ("SplatRenderMode: default", "true", True, "says otherwise"),
    ],
)
def test_antialiased_is_as_the_file_says_or_the_parameter(tmp_path, rows, comment, option, antialiased, note):
    path = save(tmp_path / "map.ply", rows, (comment,) if comment else ())
    for loaded in (load_map, load_prepared, load_prepared):  # the last one from the cache
        gaussian_map = loaded(path, options=ReadOptions(antialiased=option))
        assert gaussian_map.antialiased is antialiased
        assert note in "; ".join(gaussian_map.reading.notes)
        assert bool(note) is bool(gaussian_map.reading.notes)


def test_a_render_mode_that_is_not_known_is_refused(tmp_path, rows):
    with pytest.raises(MapError, match="not known: fisheye"):
        load_map(save(tmp_path / "map.ply", rows, ("SplatRenderMode: fisheye",)))


def test_properties_and_axes_that_are_not_used_are_named(tmp_path, rows):
    gaussian_map = load_map(save(tmp_path / "map.ply", rows, ("Vertical axis: y",), label=np.arange(500, dtype="i4")))
    assert "properties that are not used: label" in notes(gaussian_map)
    assert "'Vertical axis: y'" in notes(gaussian_map)


def library_to_ply(number: int, point: np.ndarray) -> np.ndarray:
    """Bring a point from the numbered axes to those of a .ply, as convertCoordinates of the .spz library does."""
    x, y, z = (v if (number - 1) >> bit & 1 == 5 >> bit & 1 else -v for bit, v in enumerate(point))
    return np.array([x, z, -y] if number > 8 else [x, y, z])


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("number", range(1, 17))
def test_axes_that_an_spz_declares_are_honoured(tmp_path, number, version):
    sample = sample_map(6, 3, seed=number)
    declared = struct.pack("<III", 0xADBE0003, 4, number)
    read = load_map(write_spz(tmp_path / "map", sample, version, declared, flags=2))
    # What the file holds, in its own axes.
    held = load_map(write_spz(tmp_path / "plain", sample, version), options=ReadOptions(spz_axes="ply"))
    np.testing.assert_allclose(read.means, [library_to_ply(number, mean) for mean in held.means], atol=1e-5)
    axes = np.array([library_to_ply(number, unit) for unit in np.eye(3)]).T
    np.testing.assert_allclose(covariances(read), axes @ covariances(held) @ axes.T, rtol=1e-3, atol=1e-5)
    directions = np.random.default_rng(0).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(colors(read, directions @ axes.T), colors(held, directions), atol=1e-4)
    assert read.reading.other == ""


def covariances(m: GaussianMap) -> np.ndarray:
    w, x, y, z = m.rotations.astype(float).T
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    return (rotation * m.scales[:, None, :].astype(float) ** 2) @ rotation.transpose(0, 2, 1)


def colors(m: GaussianMap, directions: np.ndarray) -> np.ndarray:
    return np.einsum("kd,nkc->ndc", np.array(harmonics(*directions.T)), m.sh)


def test_an_spz_that_declares_no_axes_is_read_as_the_parameter_says(tmp_path):
    sample = sample_map(5, 1, seed=0)
    path = write_spz(tmp_path / "map", sample, 3)  # writes right-up-back
    auto, rub, ply = (load_map(path, options=ReadOptions(spz_axes=axes)) for axes in ("auto", "rub", "ply"))
    np.testing.assert_array_equal(auto.means, rub.means)
    np.testing.assert_array_equal(ply.means, rub.means * [1, -1, -1])
    assert "RUB" in notes(auto)
    assert "map.spz_axes:=ply" in auto.reading.other
    assert rub.reading.other == ply.reading.other == ""


@pytest.mark.parametrize("number", [0, 17])
def test_axes_that_do_not_exist_are_refused(tmp_path, number):
    declared = struct.pack("<III", 0xADBE0003, 4, number)
    with pytest.raises(MapError, match=f"declares axes {number}"):
        load_map(write_spz(tmp_path / "map", sample_map(3, 0, 0), 4, declared, flags=2))


def test_extensions_and_reserved_bytes_that_are_not_known_are_named(tmp_path):
    path = write_spz(tmp_path / "map", sample_map(3, 0, 0), 4, struct.pack("<II", 0x12340001, 0), flags=2)
    assert "0x12340001" in notes(load_map(path))
    content = bytearray(path.read_bytes())
    content[25] = 1
    path.write_bytes(content)
    with pytest.raises(MapError, match="reserved"):
        load_map(path)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_an_spz_that_is_not_compressed_is_read(tmp_path, version):
    path = write_spz(tmp_path / "map", sample_map(5, 2, 0), version)
    expected = load_map(path)
    path.write_bytes(gzip.decompress(path.read_bytes()))
    np.testing.assert_array_equal(load_map(path).sh, expected.sh)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(MapError, match="truncated"):
        load_map(path)


def test_harmonics_of_degree_4_are_read_to_degree_3(tmp_path, rows):
    sample = sample_map(20, 4, seed=0)
    read = load_map(write_spz(tmp_path / "map.spz", sample, 4))
    np.testing.assert_allclose(read.sh, sample.sh[:, :16], atol=0.5 / 255 / 0.15 + 1e-5)
    assert "degree 4" in notes(read)
    rest = {f"f_rest_{i}": np.full(500, i, "f4") for i in range(72)}
    gaussian_map = load_map(save(tmp_path / "map.ply", rows, **rest))
    np.testing.assert_array_equal(gaussian_map.sh[0, 1:, 1], np.arange(24, 39))
    assert "degree 4" in notes(gaussian_map)


# Far from the origin


def georeferenced(rows: np.ndarray, offset: np.ndarray, dtype: str) -> dict[str, np.ndarray]:
    return {name: (rows[name].astype("f8") + offset[axis]).astype(dtype) for axis, name in enumerate("xyz")}


@pytest.mark.parametrize("offset", [(4.5e5, 5.4e6, 120.0), (-1e7, 3e5, 0.0)])
@pytest.mark.parametrize("cached", [False, True])
def test_an_offset_is_taken_off_in_double_precision(tmp_path, rows, offset, cached):
    path = save(tmp_path / "map.ply", rows, **georeferenced(rows, np.array(offset), "f8"))
    alignment = Similarity(2.0, translation=np.array([1.0, 2.0, 3.0]))
    read = load_prepared if cached else load_map
    for _ in range(2):
        gaussian_map = read(path, alignment)
        points = gaussian_map.S_map_splat.transform(gaussian_map.solid_points(1000).astype(np.float64))
        expected = load_map(save(tmp_path / "near.ply", rows))
        kept = 2.0 * (expected.means[expected.opacities > 0.5] + np.array(offset)) + [1.0, 2.0, 3.0]
        order, of_kept = np.lexsort(points.round(3).T), np.lexsort(kept.round(3).T)
        np.testing.assert_allclose(points[order], kept[of_kept], rtol=0, atol=1e-4)


def test_single_precision_far_away_is_refused_where_gaussians_are_smaller_than_its_steps(tmp_path, rows):
    small = {f"scale_{k}": np.full(500, np.log(0.05), "f4") for k in range(3)}
    far = georeferenced(rows, np.array([5e6, 5e5, 0.0]), "f4")  # steps of 0.5
    with pytest.raises(MapError, match=r"to 0\.5 units only.*double precision"):
        load_map(save(tmp_path / "map.ply", rows, **small, **far))
    near = georeferenced(rows, np.array([1e5, 0.0, 0.0]), "f4")
    gaussian_map = load_map(save(tmp_path / "map.ply", rows, **small, **near))
    assert "0.0078 units" in notes(gaussian_map)
    np.testing.assert_allclose(gaussian_map.S_map_splat.translation[0], 1e5, atol=100)


def test_a_photo_in_a_georeferenced_map_is_localized_to_a_millimetre(tmp_path, room_map, room_camera, room_photos):
    """The same photo gives the same answer where the map lies millions of metres away."""
    photo, offset = room_photos[0], np.array([4.5e5, 5.4e6, 120.0])
    stored = vertices(room_map, tmp_path / "room.ply")
    near = load_map(tmp_path / "room.ply")
    far = load_map(save(tmp_path / "far.ply", stored, **georeferenced(stored, offset, "f8")))
    answers = []
    for gaussian_map, shift in ((near, np.zeros(3)), (far, offset)):
        localizer = Localizer(create_renderer(gaussian_map, "cpu"), create_matcher("sift"), LocalizerOptions())
        prior = photo.T_map_camera_prior
        estimate = localizer.localize(photo.image, room_camera, make_pose(prior[:3, :3], prior[:3, 3] + shift))
        assert estimate.localized, estimate.reason
        answers.append(make_pose(estimate.T_map_camera[:3, :3], estimate.T_map_camera[:3, 3] - shift))
    assert np.linalg.norm(answers[0][:3, 3] - answers[1][:3, 3]) < 1e-3
    np.testing.assert_allclose(answers[0][:3, :3], answers[1][:3, :3], atol=1e-4)


# One bad part does not throw away the whole


def test_infinite_logits_and_logarithms_mean_what_they_mean(tmp_path, rows):
    opacity, scale = rows["opacity"].copy(), rows["scale_1"].copy()
    opacity[:2], scale[3] = [np.inf, -np.inf], -np.inf
    gaussian_map = load_map(save(tmp_path / "map.ply", rows, opacity=opacity, scale_1=scale))
    np.testing.assert_array_equal(gaussian_map.opacities[:2], [1.0, 0.0])
    assert 0 < gaussian_map.scales[3, 1] < 1e-30
    assert gaussian_map.reading.left_out == 0
    create_renderer(gaussian_map, "cpu")


def with_bad_rows(tmp_path: Path, count: int, bad: int, name: str, value: float) -> tuple[Path, np.ndarray]:
    stored = vertices(sample_map(count, 0, seed=0), tmp_path / "plain.ply")
    column = stored[name].copy()
    column[10 : 10 + bad] = value
    return save(tmp_path / "map.ply", stored, **{name: column}), np.delete(stored["x"], slice(10, 10 + bad))


@pytest.mark.parametrize(
    ("name", "value"), [("x", np.nan), ("opacity", np.nan), ("rot_2", np.inf), ("f_dc_0", -np.inf)]
)
def test_rows_without_a_gaussian_are_left_out_and_counted(tmp_path, name, value):
    path, kept = with_bad_rows(tmp_path, 5000, 50, name, value)  # in both blocks of rows
    gaussian_map = load_map(path)
    np.testing.assert_array_equal(gaussian_map.means[:, 0], kept)
    for array in ARRAYS:
        assert np.isfinite(getattr(gaussian_map, array)).all()
    assert gaussian_map.reading.left_out == 50
    assert "50 of 5000" in notes(gaussian_map)
    assert "number 10: left out" in notes(gaussian_map)
    assert load_prepared(path).reading == load_prepared(path).reading == gaussian_map.reading


def test_more_than_one_percent_of_such_rows_is_refused(tmp_path):
    path, _ = with_bad_rows(tmp_path, 5000, 51, "x", np.nan)
    with pytest.raises(MapError, match=r"51 of 5000 Gaussians.*1% of such would be left out"):
        load_map(path)


def test_a_splat_with_a_row_of_nothing_is_read(tmp_path):
    sample = sample_map(400, 0, seed=0)
    sample.means[7] = np.nan
    gaussian_map = load_map(write_splat(tmp_path / "map.splat", sample))
    assert len(gaussian_map) == 399
    assert gaussian_map.reading.left_out == 1


# Folders


def test_of_the_inria_trainers_output_the_latest_iteration_is_read(tmp_path, rows):
    for iteration, shift in ((7000, 0.0), (30000, 1.0)):
        folder = tmp_path / "out" / "point_cloud" / f"iteration_{iteration}"
        folder.mkdir(parents=True)
        save(folder / "point_cloud.ply", rows, x=rows["x"] + np.float32(shift))
    gaussian_map = load_map(tmp_path / "out")
    np.testing.assert_array_equal(gaussian_map.means[:, 0], rows["x"] + np.float32(1.0))
    assert "iteration_30000" in notes(gaussian_map)
    assert load_prepared(tmp_path / "out").reading == gaussian_map.reading


def test_a_sog_zipped_with_its_folder_is_read(tmp_path):
    folder = write_sog(tmp_path / "sog", sample_map(20, 1, 0), 2)
    with zipfile.ZipFile(tmp_path / "map.sog", "w") as archive:
        for file in folder.iterdir():
            archive.write(file, f"room/{file.name}")
        archive.writestr("__MACOSX/._meta.json", "x")
    np.testing.assert_array_equal(load_map(tmp_path / "map.sog").sh, load_map(folder).sh)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_png_images_of_gsplat_are_read(tmp_path, degree):
    sample = sample_map(49, degree, seed=0)
    path = write_gsplat_png(tmp_path / "png", sample)
    read = load_map(path)
    assert read.sh.shape == sample.sh.shape
    np.testing.assert_allclose(read.means, sample.means, atol=21 * 6.1 / 65535 + 1e-4)
    np.testing.assert_allclose(np.log(read.scales), np.log(sample.scales), atol=0.5 * 10 / 255 + 1e-4)
    np.testing.assert_allclose(read.sh, sample.sh, atol=2 / 63)
    np.testing.assert_allclose(read.opacities, sample.opacities, atol=0.02)
    cosines = np.abs(np.sum(read.rotations * sample.rotations, axis=1))
    assert cosines.min() > 0.9998
    (path / "quats.png").unlink()
    with pytest.raises(MapError, match=r"quats\.png is missing"):
        load_map(path)


def test_a_level_of_a_streamed_sog_is_read(tmp_path):
    parts = [sample_map(count, 1, seed=count) for count in (30, 20, 12)]
    environment = sample_map(5, 0, seed=9)
    path = write_streamed_sog(tmp_path / "lod", [parts[:2], parts[2:]], environment)
    finest, coarse = (load_map(path, options=ReadOptions(level=level)) for level in (0, 1))
    assert (len(finest), len(coarse)) == (55, 17)
    np.testing.assert_allclose(finest.means[:30], parts[0].means, atol=0.01)
    np.testing.assert_allclose(coarse.means[12:], environment.means, atol=0.01)
    np.testing.assert_array_equal(coarse.sh[12:, 1:], 0.0)
    assert "level 0 of 2" in notes(finest)
    assert load_prepared(path).reading == load_prepared(path).reading == finest.reading
    with pytest.raises(MapError, match=r"levels 0 to 1, no 2: set map\.level"):
        load_map(path, options=ReadOptions(level=2))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda m: m.update(version=2), "version 2"),
        (lambda m: m.update(filenames=["../secret/meta.json"] * 3), "not in its folder"),
        (lambda m: m.update(filenames=["/etc/passwd"] * 3), "not in its folder"),
        (lambda m: m.update(filenames=["gone/meta.json"] * 3), "gone/meta.json is missing"),
        (lambda m: m.update(filenames=[]), "IndexError"),
        (lambda m: m["tree"]["children"][0]["lods"]["0"].update(count=31), "fewer than lod-meta.json takes"),
        (lambda m: m["tree"]["children"][0]["lods"]["0"].update(offset=-1), "no range of rows"),
        (lambda m: m.update(tree=7), "AttributeError"),
    ],
)
def test_a_streamed_sog_that_is_damaged(tmp_path, change, match):
    path = write_streamed_sog(tmp_path / "lod", [[sample_map(30, 0, 0), sample_map(20, 0, 1)]])
    meta = json.loads((path / "lod-meta.json").read_text())
    change(meta)
    (path / "lod-meta.json").write_text(json.dumps(meta))
    with pytest.raises(MapError, match=match):
        load_map(path)


# Files of others are named for what they are


def zipped(*names: str) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in names:
            archive.writestr(name, b"x" * 100)
    return stream.getvalue()


def ksplat() -> bytes:
    header = struct.pack("<4B4IH", 0, 1, 0, 0, 1, 1, 100, 100, 1)
    return header.ljust(4096 + 1024, b"\0") + np.random.default_rng(0).bytes(100 * 24)


def ply_text(properties: str, count: int = 3) -> bytes:
    names = properties.split()
    lines = ["ply", "format ascii 1.0", f"element vertex {count}", *(f"property float {name}" for name in names)]
    return "\n".join([*lines, "end_header", *[" ".join("1" for _ in names)] * count, ""]).encode()


GAUSSIAN = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 rot_0 rot_1 rot_2 rot_3"
IMAGE = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
FOREIGN: dict[str, tuple[bytes, str]] = {
    "lfs.ply": (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n", "git lfs pull"),
    "scene.ksplat": (ksplat(), "ksplat.*splat-transform"),
    "scene.rad": (b"RAD0" + bytes(500), r"\.rad of Spark"),
    "chunk.radc": (b"RADC" + bytes(500), r"\.rad of Spark"),
    "scene.lcc": (json.dumps({"totalLevel": 5, "cellLengthX": 30}).encode(), r"\.lcc of XGRIDS.*splat-transform"),
    "scene.lcc2": (json.dumps({"splatType": ".sog", "totalLevels": 5, "root": {}}).encode(), r"\.lcc2 of XGRIDS"),
    "scene.glb": (b"glTF" + struct.pack("<II", 2, 300) + bytes(300), "glTF.*3dgs_io"),
    "scene.gltf": (
        json.dumps({"asset": {"version": "2.0"}, "extensionsUsed": ["KHR_gaussian_splatting"]}).encode(),
        "glTF with Gaussians",
    ),
    "scene.usdc": (b"PXR-USDC" + bytes(300), "USD"),
    "scene.usda": (b"#usda 1.0\ndef ParticleField3DGaussianSplat {}\n", "USD"),
    "scene.usdz": (zipped("default.usda"), "USD"),
    "ckpt.pt": (zipped("archive/data.pkl", "archive/version"), "checkpoint of PyTorch.*may run code.*ns-export"),
    "old.ckpt": (pickle.dumps({"means": [1.0] * 100}, 2), "checkpoint"),
    "arrays.npz": (zipped("means.npy"), "numpy"),
    "map.zip": (zipped("deep/map.ply"), r"zip\), with deep/map\.ply in it: unpack it"),
    "lod.zip": (zipped("lod/lod-meta.json", "lod/0_0/meta.json"), r"streamed \.sog in it"),
    "photos.zip": (zipped("a.jpg"), "zip without meta.json"),
    "map.ply.gz": (gzip.compress(ply_text(GAUSSIAN)), r"gzip\), with a \.ply in it: unpack it"),
    "map.tar": (bytes(257) + b"ustar\0" + bytes(1000), "tar.*unpack"),
    "map.zst": (b"\x28\xb5\x2f\xfd" + bytes(100), "zstd.*unpack"),
    "2dgs.ply": (ply_text(GAUSSIAN), "2DGS"),
    "scaffold.ply": (ply_text("x y z f_offset_0 f_anchor_feat_0 opacity scale_0 rot_0"), "Scaffold-GS"),
    "spacetime.ply": (ply_text(GAUSSIAN + " scale_2 trbf_center motion_0"), "moving Gaussians"),
    "beta.ply": (ply_text(GAUSSIAN + " scale_2 beta"), "Deformable Beta"),
    "cloudcompare.ply": (ply_text("x y z scalar_f_dc_0 scalar_opacity scalar_scale_0 scalar_rot_0"), "CloudCompare"),
    "points.ply": (ply_text("x y z"), "point cloud"),
    "mesh.ply": (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 0 0\n",
        "mesh",
    ),
    "points.pcd": (b"# .PCD v0.7 - Point Cloud Data\nVERSION 0.7\n", "point cloud"),
    "points.las": (b"LASF" + bytes(400), "point cloud"),
    "image.png": (cv2.imencode(".png", IMAGE)[1].tobytes(), "PNG image"),
    "image.jpg": (cv2.imencode(".jpg", IMAGE)[1].tobytes(), "JPEG image"),
    "means_l.webp": (cv2.imencode(".webp", IMAGE)[1].tobytes(), "WebP.*meta.json"),
    "bag.mcap": (b"\x89MCAP0\r\n" + bytes(400), "recording"),
    "page.html": (b"<!DOCTYPE html><html>denied</html>", "web page"),
    "transforms.json": (json.dumps({"frames": [], "fl_x": 1.0}).encode(), "cameras of a scene"),
    "config.json": (json.dumps({"a": 1}).encode(), "no meta.json of a .sog"),
    "map.ply.gsfeatloc-cache": (b"gsfeatloc_ros prepared map\n" + bytes(100), "cache of a map"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_file_of_others_is_named(tmp_path, name):
    content, match = FOREIGN[name]
    path = tmp_path / "map"  # by its content, not by its name
    path.write_bytes(content)
    with pytest.raises(MapError, match=match) as error:
        load_map(path)
    assert "damaged" not in str(error.value)


def test_the_files_that_lie_beside_a_map_are_named(tmp_path):
    """As they are written: a copy of how they begin would grow old."""
    save_index(tmp_path / "index", made_up_index(views=2, features=3, dimension=64).index, {})
    with pytest.raises(MapError, match="index of a map: name the map beside it"):
        load_map(tmp_path / "index")
    write_ply(tmp_path / "map.ply", sample_map(100, 0, 0))
    load_prepared(tmp_path / "map.ply")
    with pytest.raises(MapError, match="cache of a map: name the map beside it"):
        load_map(tmp_path / "map.ply.gsfeatloc-cache")


def test_folders_of_others_are_named(tmp_path):
    with pytest.raises(MapError, match=r"folder without meta\.json"):
        load_map(tmp_path)
    (tmp_path / "scene.lcc").touch()
    with pytest.raises(MapError, match=r"\.lcc of XGRIDS"):
        load_map(tmp_path)
    (tmp_path / "ckpts").mkdir()
    with pytest.raises(MapError, match="output folder of gsplat"):
        load_map(tmp_path)
    (tmp_path / "nerfstudio_models").mkdir()
    (tmp_path / "config.yml").touch()
    with pytest.raises(MapError, match="ns-export"):
        load_map(tmp_path)


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a file changed at a few places, near the beginning more often, and of a .splat's size."""
    changed = bytearray(content[: int(rng.integers(1, len(content) + 1))] if rng.random() < 0.3 else content)
    for _ in range(rng.integers(1, 20)):
        at = rng.integers(0, min(len(changed), 64) if rng.random() < 0.5 else len(changed))
        changed[at] = rng.integers(0, 256)
    return bytes(changed[: len(changed) // 32 * 32] or changed)


def accepted(tmp_path: Path, count: int) -> list[str]:
    """Return the names of the foreign files that were read as maps after `count` mutations."""
    rng, path, read = np.random.default_rng(0), tmp_path / "map", []
    names = list(FOREIGN)
    for index in range(count):
        name = names[index % len(names)]
        path.write_bytes(mutated(FOREIGN[name][0], rng))
        try:
            load_map(path)
        except MapError:
            continue
        read.append(name)
    return read


def test_mutated_foreign_files_are_not_accepted(tmp_path):
    assert accepted(tmp_path, 300) == []


@pytest.mark.nightly
def test_none_of_10000_mutated_foreign_files_is_accepted(tmp_path):
    assert accepted(tmp_path, 10_000) == []
