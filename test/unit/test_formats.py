"""Reading maps in the compressed formats: what they hold, what real files show, and what damage does."""

from __future__ import annotations

import gzip
import json
import shutil
import struct
import tracemalloc
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from backports import zstd
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from map_files import (
    ARRAYS,
    bundle,
    check_damaged,
    sample_map,
    webp,
    write_compressed_ply,
    write_sog,
    write_splat,
    write_spz,
)

from gsfeatloc_ros.maps import GaussianMap, MapError, assemble, load_map
from gsfeatloc_ros.maps.assemble import MAX_GAUSSIANS
from gsfeatloc_ros.maps.ply import write_ply

# tmp_path is shared by the examples of one test: each overwrites the files.
same_folder = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
counts = st.integers(1, 300)
degrees = st.integers(0, 3)
seeds = st.integers(0, 2**32 - 1)


def assert_rotations_agree(a: np.ndarray, b: np.ndarray, degrees: float) -> None:
    cosines = np.abs(np.sum(a.astype(np.float64) * b, axis=1)).clip(max=1.0)
    assert np.degrees(2 * np.arccos(cosines)).max() < degrees


def array_bytes(gaussian_map: GaussianMap) -> int:
    return sum(getattr(gaussian_map, name).nbytes for name in ARRAYS)


# What the files hold, to what their bits can say


@same_folder
@given(count=counts, degree=degrees, seed=seeds, color_bounds=st.booleans())
def test_compressed_ply_reads_back(tmp_path, count, degree, seed, color_bounds):
    written = sample_map(count, degree, seed)
    read = load_map(write_compressed_ply(tmp_path / "map", written, color_bounds))
    assert read.sh.shape == written.sh.shape
    np.testing.assert_allclose(read.means, written.means, atol=0.5 * 40 / 1023 + 1e-4)
    np.testing.assert_allclose(np.log(read.scales), np.log(written.scales), atol=0.5 * 10 / 1023 + 1e-4)
    np.testing.assert_allclose(read.opacities, written.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(read.sh[:, 0], written.sh[:, 0], atol=0.5 / 255 / 0.282 + 1e-5)
    np.testing.assert_allclose(read.sh[:, 1:], written.sh[:, 1:], atol=0.5 * 8 / 256 + 1e-5)
    assert_rotations_agree(read.rotations, written.rotations, 0.25)


@same_folder
@given(count=counts, seed=seeds)
def test_splat_reads_back(tmp_path, count, seed):
    written = sample_map(count, 0, seed)
    read = load_map(write_splat(tmp_path / "map", written))
    np.testing.assert_array_equal(read.means, written.means)
    np.testing.assert_array_equal(read.scales, written.scales)
    np.testing.assert_allclose(read.opacities, written.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(read.sh, written.sh, atol=0.5 / 255 / 0.282 + 1e-5)
    assert_rotations_agree(read.rotations, written.rotations, 1.0)


@pytest.mark.parametrize("beginning", [b"{", b"{\n", b'{"', b"PK", b"\x1f\x8b"])
def test_splat_may_begin_as_other_formats_do(tmp_path, beginning):
    """Its first bytes are a coordinate: of a random one, one in 256 begins with {."""
    path = write_splat(tmp_path / "map", sample_map(5, 0, 0))
    path.write_bytes(beginning + path.read_bytes()[len(beginning) :])
    assert len(load_map(path)) == 5


@pytest.mark.parametrize("version", [1, 2, 3, 4])
@same_folder
@given(count=counts, degree=degrees, seed=seeds)
def test_spz_reads_back_with_the_axes_of_ply(tmp_path, version, count, degree, seed):
    written = sample_map(count, degree, seed)
    read = load_map(write_spz(tmp_path / "map", written, version))
    assert read.sh.shape == written.sh.shape
    assert not read.antialiased
    np.testing.assert_allclose(read.means, written.means, atol=20 / 2048 if version == 1 else 0.5 / 4096 + 1e-5)
    np.testing.assert_allclose(np.log(read.scales), np.log(written.scales), atol=0.5 / 16 + 1e-5)
    np.testing.assert_allclose(read.opacities, written.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(read.sh[:, 0], written.sh[:, 0], atol=0.5 / 255 / 0.15 + 1e-5)
    np.testing.assert_allclose(read.sh[:, 1:], written.sh[:, 1:], atol=0.5 / 128 + 1e-5)
    # Of version 2 the least known component, w, is what the others leave.
    assert_rotations_agree(read.rotations, written.rotations, 0.3 if version >= 3 else 15.0)


@pytest.mark.parametrize("version", [1, 2])
@same_folder
@given(count=counts, degree=degrees, seed=seeds)
def test_sog_reads_back(tmp_path, version, count, degree, seed):
    written = sample_map(count, degree, seed)
    folder = write_sog(tmp_path / "sog", written, version)
    read = load_map(folder)
    assert read.sh.shape == written.sh.shape
    np.testing.assert_allclose(read.means, written.means, atol=21 * 6.1 / 65535 + 1e-4)
    np.testing.assert_allclose(np.log(read.scales), np.log(written.scales), atol=0.5 * 10 / 255 + 1e-4)
    # Version 1 holds logits, whose steps are widest in opacity halfway.
    np.testing.assert_allclose(read.opacities, written.opacities, atol=0.5 / 255 + 1e-6 if version == 2 else 0.008)
    np.testing.assert_allclose(read.sh[:, 0], written.sh[:, 0], atol=0.5 * 2 / 255 + 1e-5)
    palette = written.sh[np.arange(count) % 64, 1:]
    np.testing.assert_allclose(read.sh[:, 1:], palette, atol=0.5 * 2 / 255 + 1e-5)
    assert_rotations_agree(read.rotations, written.rotations, 1.2)


@pytest.mark.parametrize("version", [1, 2])
def test_a_sog_is_the_same_in_a_zip_in_a_folder_and_by_its_meta_json(tmp_path, version):
    folder = write_sog(tmp_path / "sog", sample_map(150, 2, seed=0), version)
    expected = load_map(folder)
    for path in (folder / "meta.json", bundle(tmp_path / "map.sog", folder)):
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(load_map(path), name), getattr(expected, name))


def test_a_sog_has_a_palette_of_more_than_one_row(tmp_path):
    written = sample_map(300, 1, seed=0)
    read = load_map(write_sog(tmp_path / "sog", written, 2, palette=300))
    np.testing.assert_allclose(read.sh[:, 1:], written.sh[:, 1:], atol=0.5 * 2 / 255 + 1e-5)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_spz_tells_of_antialiased_training(tmp_path, version):
    assert load_map(write_spz(tmp_path / "map", sample_map(3, 0, 0), version, flags=1)).antialiased


@pytest.mark.parametrize(
    ("extra", "antialiased"),
    [({}, False), ({"model": "antialiased"}, True), ({"antialias": True}, True), ({"antialias": False}, False)],
)
def test_sog_tells_of_antialiased_training(tmp_path, extra, antialiased):
    assert load_map(write_sog(tmp_path / "sog", sample_map(3, 0, 0), 2, **extra)).antialiased is antialiased


def test_compressed_ply_tells_of_antialiased_training(tmp_path):
    path = write_compressed_ply(tmp_path / "map", sample_map(3, 0, 0), comment="SplatRenderMode: mip")
    assert load_map(path).antialiased


def test_extensions_of_spz_are_passed_over(tmp_path):
    camera = struct.pack("<II3f", 0xADBE0002, 12, 0, 1, 2)
    for version in (3, 4):
        assert len(load_map(write_spz(tmp_path / "map", sample_map(3, 1, 0), version, camera, flags=2))) == 3


# Damage: each kind is named


def refused(path: Path, match: str, peak_limit: float = 2e6) -> None:
    """`path` is refused with a message that names it, without taking much memory."""
    tracemalloc.start()
    try:
        with pytest.raises(MapError, match=match) as error:
            load_map(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert str(path) in str(error.value)
    assert peak < peak_limit


def test_bytes_of_no_format(tmp_path):
    (tmp_path / "map").write_bytes(b"\xff" * 320)
    refused(tmp_path / "map", "of no format that is read")
    (tmp_path / "map").write_bytes(b"hello")
    refused(tmp_path / "map", "of no format that is read")


@pytest.mark.parametrize(("opacity", "seen"), [(1e-4, False), (0.0039, False), (0.004, True)])
def test_a_map_in_which_nothing_can_be_seen(tmp_path, opacity, seen):
    made = sample_map(20, 0, 0)
    write_ply(tmp_path / "map.ply", replace(made, opacities=np.full_like(made.opacities, opacity)))
    if seen:
        assert len(load_map(tmp_path / "map.ply").opacities) == 20
        return
    with pytest.raises(MapError, match="nothing in it can be seen: none of its 20 Gaussians"):
        load_map(tmp_path / "map.ply")


def test_more_gaussians_than_are_read(tmp_path):
    with (tmp_path / "map.splat").open("wb") as stream:
        stream.truncate(32 * (MAX_GAUSSIANS + 1))  # a file of holes
    refused(tmp_path / "map.splat", f"at most {MAX_GAUSSIANS}")


def test_splat_of_negative_scales(tmp_path):
    gaussian_map = sample_map(4, 0, 0)
    gaussian_map.scales[2, 1] = -1.0
    refused(write_splat(tmp_path / "map", gaussian_map), "no positive scale")


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize(
    ("header", "match"),
    [
        ({"count": 0}, "no Gaussians"),
        ({"count": 2**32 - 1}, "at most"),
        ({"count": MAX_GAUSSIANS}, "damaged"),
        ({"count": 41}, "truncated"),
        ({"sh_degree": 5}, "degree 5"),
        ({"flags": 4}, "flag 0x4"),
        ({"fractional_bits": 25}, "25 fractional bits"),
    ],
)
def test_spz_header(tmp_path, version, header, match):
    refused(write_spz(tmp_path / "map", sample_map(40, 1, 0), version, **header), match)


@pytest.mark.parametrize("version", [0, 5, 77])
def test_spz_of_unknown_version(tmp_path, version):
    path = write_spz(tmp_path / "map", sample_map(4, 0, 0), 4)
    content = bytearray(path.read_bytes())
    content[4] = version
    path.write_bytes(content)
    refused(path, f"version {version}")
    (tmp_path / "gzip").write_bytes(gzip.compress(bytes(content)))
    refused(tmp_path / "gzip", f"version {version}")


def test_gzip_of_something_else(tmp_path):
    (tmp_path / "map").write_bytes(gzip.compress(b"a letter to a friend"))
    refused(tmp_path / "map", r"no \.spz in it: unpack it")


def test_gzip_bomb(tmp_path):
    head = b"NGSP" + struct.pack("<IIBBBB", 3, 2_000_000, 0, 12, 0, 0)
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    (tmp_path / "map").write_bytes(packer.compress(head + bytes(40_000_000)) + packer.flush())
    refused(tmp_path / "map", "claims 40000000 bytes")


def test_zstd_bomb(tmp_path):
    """Streams of zeros of the right sizes, which compress so well that no map can be in them."""
    count = 2_000_000
    streams = [zstd.compress(bytes(n * count)) for n in (9, 1, 3, 3, 4)]
    table = b"".join(struct.pack("<QQ", len(s), n * count) for s, n in zip(streams, (9, 1, 3, 3, 4), strict=True))
    head = b"NGSP" + struct.pack("<IIBBBBI12x", 4, count, 0, 12, 0, 5, 32)
    (tmp_path / "map").write_bytes(head + table + b"".join(streams))
    refused(tmp_path / "map", "claims 40000000 bytes")


def test_zstd_frame_that_asks_for_much_memory(tmp_path):
    path = write_spz(tmp_path / "map", sample_map(40, 0, 0), 4)
    content = path.read_bytes()
    # A frame header without a content size, with a window of 2^31 bytes, before an empty last block.
    frame = b"\x28\xb5\x2f\xfd\x00" + bytes([21 << 3]) + b"\x01\x00\x00"
    size = struct.unpack_from("<Q", content, 32)[0]
    content = content[:32] + struct.pack("<Q", len(frame)) + content[40:112] + frame + content[112 + size :]
    path.write_bytes(content)
    refused(path, "damaged")


@pytest.mark.parametrize("name", ["packed_rotation", "min_scale_y"])
def test_compressed_ply_without_a_property(tmp_path, name):
    path = write_compressed_ply(tmp_path / "map", sample_map(4, 0, 0))
    path.write_bytes(path.read_bytes().replace(name.encode(), b"other"))
    refused(path, f"lacks .*{name}")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (b"element chunk 2", b"element chunk 3", "truncated"),
        (b"element chunk", b"element other", "no element 'chunk'"),
        (b"element vertex 300", b"element vertex 999999999", "truncated"),
        (b"element sh 300", b"element sh 10", "damaged"),
        (b"uchar f_rest_8", b"uchar f_rest_9", "f_rest_0"),
        (b"property uint packed_color", b"property float packed_color", "32-bit packed_color"),
    ],
)
def test_compressed_ply_of_another_layout(tmp_path, old, new, match):
    path = write_compressed_ply(tmp_path / "map", sample_map(300, 1, 0))
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new))
    refused(path, match)


def test_compressed_ply_with_infinite_bounds(tmp_path):
    path = write_compressed_ply(tmp_path / "map", sample_map(4, 0, 0))
    content = path.read_bytes()
    start = content.index(b"end_header\n") + 11
    path.write_bytes(content[: start + 24] + struct.pack("<f", -np.inf) + content[start + 28 :])
    refused(path, "bounds")


def rewrite_meta(folder: Path, change) -> Path:
    meta = json.loads((folder / "meta.json").read_text())
    change(meta)
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda m: m.update(version=3), "version 3"),
        (lambda m: m.update(model="2dgs"), "2DGS"),
        (lambda m: m.update(count=0), "no Gaussians"),
        (lambda m: m.update(count=-1), "-1 is no whole number"),
        (lambda m: m.update(count=1e3), "no whole number"),
        (lambda m: m.update(count=MAX_GAUSSIANS + 1), "at most"),
        (lambda m: m.update(count=MAX_GAUSSIANS), "damaged: it claims"),
        (lambda m: m.update(count=200), "does not fit the number"),
        (lambda m: m.pop("quats"), "KeyError: 'quats'"),
        (lambda m: m.update(means=7), "TypeError"),
        (lambda m: m["means"].update(mins=[0, 0]), "not 3 finite numbers"),
        (lambda m: m["means"].update(maxs=[1, 2, float("nan")]), "not 3 finite numbers"),
        (lambda m: m["means"].update(maxs=[1, 1e30, 1]), "NaN, infinite or too large"),
        (lambda m: m["means"].update(files=["means_l.webp"]), "too few images"),
        (lambda m: m["scales"].update(codebook=[0.0] * 257), "codebook of 257"),
        (lambda m: m["scales"].update(codebook=[0.0]), "NaN"),
        (lambda m: m["sh0"].update(files=["gone.webp"]), "gone.webp is missing"),
        (lambda m: m["sh0"].update(files=["meta.json"]), "not a WebP"),
        (lambda m: m["shN"].update(bands=4), "degree 4"),
        (lambda m: m["shN"].update(bands=2), "does not fit its harmonics"),
        (lambda m: m["shN"].update(bands=1.0), "no whole number"),
    ],
)
def test_sog_meta(tmp_path, change, match):
    refused(rewrite_meta(write_sog(tmp_path / "sog", sample_map(100, 1, 0), 2), change), match)


@pytest.mark.parametrize("name", ["../secret.webp", "/etc/passwd", "..", "", "a\\b.webp", "c:x.webp", "a\0b", 7, None])
def test_names_in_a_sog_do_not_lead_out_of_it(tmp_path, name):
    folder = write_sog(tmp_path / "sog", sample_map(10, 0, 0), 2)
    shutil.copy(folder / "quats.webp", tmp_path / "secret.webp")
    rewrite_meta(folder, lambda meta: meta["quats"].update(files=[name]))
    refused(folder, "plain file name")
    refused(bundle(tmp_path / "map.sog", folder), "plain file name")


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "empty"),
        (b"{", "damaged JSON"),
        (b"[]", "looks like a text"),
        (b"null", "looks like a text"),
        (b"{}", "no meta.json of a .sog"),
        (b"\xff", "no format that is read"),
        (b'{"a":' * 100_000, "damaged JSON"),
        (b'{"version": 2}', "no meta.json of a .sog"),
        (b'{"version": 2, "means": {}}', "meta.json is damaged or not that of a .sog"),
    ],
    ids=range(9),
)
def test_sog_meta_of_no_sog(tmp_path, content, match):
    folder = write_sog(tmp_path / "sog", sample_map(10, 0, 0), 2)
    (folder / "meta.json").write_bytes(content)
    refused(folder / "meta.json", match)


def test_sog_labels_beyond_the_palette(tmp_path):
    folder = write_sog(tmp_path / "sog", sample_map(10, 1, 0), 2)
    (folder / "shN_labels.webp").write_bytes(webp(np.full((4, 4, 3), 200, np.uint8)))
    refused(folder, "beyond the 64 of its palette")


def test_sog_rotations_without_their_tag(tmp_path):
    folder = write_sog(tmp_path / "sog", sample_map(10, 0, 0), 2)
    (folder / "quats.webp").write_bytes(webp(np.full((4, 4, 4), 128, np.uint8)))
    refused(folder, "alpha under 252")


def test_webp_that_claims_to_be_huge(tmp_path):
    folder = write_sog(tmp_path / "sog", sample_map(10, 0, 0), 2)
    image = bytearray((folder / "quats.webp").read_bytes())
    image[21:25] = struct.pack("<I", 1 << 28 | 0x3FFF << 14 | 0x3FFF)
    (folder / "quats.webp").write_bytes(image)
    refused(folder, "16384 x 16384 pixels")


@pytest.mark.parametrize("channels", [3, 4])
def test_webp_that_is_lossy(tmp_path, channels):
    folder = write_sog(tmp_path / "sog", sample_map(10, 0, 0), 2)
    pixels = np.full((4, 4, channels), 128, np.uint8)
    (folder / "scales.webp").write_bytes(cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes())
    refused(folder, "lossy")


def test_files_larger_than_any_map(tmp_path):
    for name, head, size in (("map.spz", b"NGSP", 66 * MAX_GAUSSIANS), ("meta.json", b"{" + 300 * b" ", 1 << 30)):
        with (tmp_path / name).open("wb") as stream:
            stream.write(head)
            stream.truncate(size)  # a file of holes
        refused(tmp_path / name, "too large")


def test_zip_of_something_else(tmp_path):
    with zipfile.ZipFile(tmp_path / "map.sog", "w") as archive:
        archive.writestr("letter.txt", "hello")
    refused(tmp_path / "map.sog", "zip without meta.json")


def test_zip_with_a_name_that_is_no_text(tmp_path):
    with zipfile.ZipFile(tmp_path / "map.sog", "w") as archive:
        archive.writestr("é.json", "hello")
    content = (tmp_path / "map.sog").read_bytes()
    (tmp_path / "map.sog").write_bytes(content.replace("é".encode(), b"\xff\xff"))
    refused(tmp_path / "map.sog", "damaged")


def test_zip_bomb(tmp_path):
    with zipfile.ZipFile(tmp_path / "map.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * 50_000_000)
    refused(tmp_path / "map.sog", "claims 50000000 bytes")


def test_zip_of_very_many_files(tmp_path):
    """To list a million takes 400 MB, and the list is not what the end of the zip says of it."""
    with zipfile.ZipFile(tmp_path / "map.sog", "w") as archive:
        archive.writestr("meta.json", b"{}")
    content = (tmp_path / "map.sog").read_bytes()
    start = content.index(b"PK\x01\x02")
    end = content.index(b"PK\x05\x06")
    entries = 20_000 * content[start:end]
    tail = content[end : end + 12] + struct.pack("<I", len(entries)) + content[end + 16 :]
    (tmp_path / "map.sog").write_bytes(content[:start] + entries + tail)
    refused(tmp_path / "map.sog", "is a zip of 1 files in a list of 1100000 bytes, so no .sog")


def test_webp_of_another_canvas_than_its_picture(tmp_path):
    """The decoder would take memory for the canvas: it is given the picture alone."""
    folder = write_sog(tmp_path / "sog", sample_map(10, 0, 0), 2)
    expected = load_map(folder)
    image = (folder / "quats.webp").read_bytes()
    canvas = b"VP8X" + struct.pack("<II", 10, 0x10) + 2 * (16_000).to_bytes(3, "little")
    chunks = b"WEBP" + canvas + image[12:]
    (folder / "quats.webp").write_bytes(b"RIFF" + struct.pack("<I", len(chunks)) + chunks)
    np.testing.assert_array_equal(load_map(folder).rotations, expected.rotations)


@pytest.mark.parametrize("version", [2, 4])
def test_a_map_that_expands_by_hundreds(tmp_path, version):
    written = sample_map(100, 3, 0)
    path = write_spz(tmp_path / "map", written, version)
    content = bytearray(path.read_bytes() if version == 4 else gzip.decompress(path.read_bytes()))
    content[8:12] = struct.pack("<I", 50_000)
    path.write_bytes(content if version == 4 else gzip.compress(bytes(content)))
    refused(path, r"is damaged: it claims 32\d0000 bytes of Gaussians compressed to")


@pytest.mark.parametrize("available", [0, 20_000, 39_000])
def test_a_map_that_takes_more_memory_than_there_is(tmp_path, monkeypatch, available):
    """400 Gaussians take 46 kB while they are prepared, and a fifth stays for others."""
    path = write_splat(tmp_path / "map", sample_map(400, 0, 0))
    monkeypatch.setattr(assemble, "available_memory", lambda: available)
    refused(path, r"takes 0.0 GB of memory to load, and 0.0 GB are available")
    monkeypatch.setattr(assemble, "available_memory", lambda: 60_000)
    assert len(load_map(path)) == 400


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_zip_methods_that_no_sog_has(tmp_path, method):
    with zipfile.ZipFile(tmp_path / "map.sog", "w", method) as archive:
        archive.writestr("meta.json", b"{}")
    refused(tmp_path / "map.sog", "deflate")


# Any damage gives a MapError or a valid map


FORMATS = {
    "compressed ply": lambda path, m: write_compressed_ply(path, m),
    "splat": lambda path, m: write_splat(path, m),
    "spz 1": lambda path, m: write_spz(path, m, 1),
    "spz 2": lambda path, m: write_spz(path, m, 2),
    "spz 3": lambda path, m: write_spz(path, m, 3),
    "spz 4": lambda path, m: write_spz(path, m, 4),
    "sog 1": lambda path, m: bundle(path, write_sog(path.with_suffix(".folder"), m, 1)),
    "sog 2": lambda path, m: bundle(path, write_sog(path.with_suffix(".folder"), m, 2)),
}


@pytest.fixture(scope="module")
def samples(tmp_path_factory) -> dict[str, bytes]:
    """A small file of each format."""
    folder = tmp_path_factory.mktemp("samples")
    return {name: write(folder / name, sample_map(20, 1, 0)).read_bytes() for name, write in FORMATS.items()}


@pytest.mark.parametrize("name", FORMATS)
@same_folder
@given(data=st.data())
def test_truncation_anywhere(tmp_path, samples, name, data):
    content = samples[name]
    keep = data.draw(st.integers(0, len(content) - 1))
    (tmp_path / "map").write_bytes(content[:keep])
    if name == "splat" and keep and keep % 32 == 0:
        assert len(load_map(tmp_path / "map")) == keep // 32  # nothing tells that there were more
    else:
        with pytest.raises(MapError):
            load_map(tmp_path / "map")


@pytest.mark.parametrize("name", FORMATS)
@same_folder
@given(data=st.data())
def test_flipped_bytes(tmp_path, samples, name, data):
    content = bytearray(samples[name])
    # Most of the positions near the beginning, where headers are.
    position = st.one_of(st.integers(0, min(400, len(content) - 1)), st.integers(0, len(content) - 1))
    for at, value in data.draw(st.lists(st.tuples(position, st.integers(0, 255)), min_size=1, max_size=4)):
        content[at] = value
    (tmp_path / "map").write_bytes(content)
    check_damaged(tmp_path / "map", 4e6)


@pytest.mark.parametrize("claim", [2**16, 2**22, 2**32 - 2])
def test_a_sog_whose_file_claims_more_than_there_is_takes_no_memory(tmp_path, samples, claim):
    content = bytearray(samples["sog 2"])
    # In the zip's directory the compressed size is 20 bytes after an entry begins.
    at = content.index(b"PK\x01\x02") + 20
    content[at : at + 4] = claim.to_bytes(4, "little")
    path = tmp_path / "map"
    path.write_bytes(content)
    check_damaged(path, 1e6)
    with pytest.raises(MapError, match=f"claims to take {claim} bytes"):
        load_map(path)


@pytest.mark.parametrize("version", [1, 2, 3])
@same_folder
@given(data=st.data())
def test_flipped_bytes_inside_the_gzip(tmp_path, samples, version, data):
    content = bytearray(gzip.decompress(samples[f"spz {version}"]))
    position = st.one_of(st.integers(0, 15), st.integers(0, len(content) - 1))
    for at, value in data.draw(st.lists(st.tuples(position, st.integers(0, 255)), min_size=1, max_size=4)):
        content[at] = value
    (tmp_path / "map").write_bytes(gzip.compress(bytes(content)))
    check_damaged(tmp_path / "map", 4e6)


@pytest.mark.parametrize("version", [1, 2])
@same_folder
@given(data=st.data())
def test_flipped_bytes_in_the_files_of_a_sog(tmp_path, version, data):
    folder = tmp_path / "sog"
    if not folder.exists():
        write_sog(folder, sample_map(20, 1, 0), version)
    file = data.draw(st.sampled_from(sorted(folder.iterdir())))
    before = file.read_bytes()
    content = bytearray(before)
    position = st.one_of(st.integers(0, 40), st.integers(0, len(content) - 1))
    for at, value in data.draw(st.lists(st.tuples(position, st.integers(0, 255)), min_size=1, max_size=4)):
        content[at] = value
    keep = data.draw(st.integers(0, len(content)))
    file.write_bytes(content[: max(keep, len(content) // 2)])
    try:
        check_damaged(folder, 4e6)
    finally:
        file.write_bytes(before)


MAGICS = [b"ply\n", b"NGSP\x04\0\0\0", b"NGSP\x03\0\0\0", b"\x1f\x8b\x08\0", b"PK\x03\x04", b"PK\x05\x06", b"{", b""]


@same_folder
@given(magic=st.sampled_from(MAGICS), content=st.binary(max_size=400))
def test_random_bytes_behind_each_magic(tmp_path, magic, content):
    (tmp_path / "map").write_bytes(magic + content)
    check_damaged(tmp_path / "map", 4e6)


@same_folder
@given(content=st.binary(max_size=200), version=st.integers(1, 3))
def test_random_bytes_inside_a_gzip(tmp_path, content, version):
    (tmp_path / "map").write_bytes(gzip.compress(b"NGSP" + struct.pack("<I", version) + content))
    check_damaged(tmp_path / "map", 4e6)


def test_a_text_is_no_splat(tmp_path):
    path = tmp_path / "map"
    path.write_text("#!/usr/bin/env python3\n" + 41 * " ")
    assert path.stat().st_size % 32 == 0
    refused(path, "looks like a text")
