"""Reading and writing maps as .ply."""

import os
import struct
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from map_files import ARRAYS, SH_C0, check_damaged
from plyfile import PlyData, PlyElement

from gsfeatloc_ros.maps import GaussianMap, MapError, load_map
from gsfeatloc_ros.maps.ply import write_ply

# tmp_path is shared by the examples of one test: each overwrites the file.
same_folder = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def stored_values(count: int, degree: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random values of `count` Gaussians as the INRIA trainer stores them, by property name and in its order."""
    rng = np.random.default_rng(seed)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return {name: rng.normal(0, 2, count).astype(np.float32) for name in names}


def save(path, values, dtype="f4", text=False, byte_order="<"):
    """Write stored values with plyfile alone, of one type or, with None, of their own."""
    count = len(next(iter(values.values())))
    vertices = np.empty(count, dtype=[(name, dtype or column.dtype) for name, column in values.items()])
    for name, column in values.items():
        vertices[name] = column
    PlyData([PlyElement.describe(vertices, "vertex")], text=text, byte_order=byte_order).write(str(path))
    return path


def random_map(count: int, degree: int, seed: int) -> GaussianMap:
    """Of any Gaussians, the first of which can be seen: a map without one is refused."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(count, 4))
    opacities = rng.uniform(0, 1, count).astype(np.float32)
    opacities[:1] = 0.5 + 0.5 * opacities[:1]
    return GaussianMap(
        means=rng.normal(0, 10, (count, 3)).astype(np.float32),
        scales=np.exp(rng.normal(-3, 2, (count, 3))).astype(np.float32),
        rotations=(rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        opacities=opacities,
        sh=rng.normal(0, 1, (count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_activates_what_the_trainer_stores(tmp_path, degree):
    values = stored_values(50, degree)
    gaussian_map = load_map(save(tmp_path / "map.ply", values))

    assert len(gaussian_map) == 50
    assert gaussian_map.sh_degree == degree
    for i in (0, 17, 49):
        v = {name: float(column[i]) for name, column in values.items()}
        np.testing.assert_allclose(gaussian_map.means[i], [v["x"], v["y"], v["z"]])
        np.testing.assert_allclose(gaussian_map.scales[i], [np.exp(v[f"scale_{k}"]) for k in range(3)], rtol=1e-5)
        np.testing.assert_allclose(gaussian_map.opacities[i], 1 / (1 + np.exp(-v["opacity"])), rtol=1e-5)
        quaternion = np.array([v[f"rot_{k}"] for k in range(4)])
        np.testing.assert_allclose(gaussian_map.rotations[i], quaternion / np.linalg.norm(quaternion), atol=1e-6)
        coefficients = (degree + 1) ** 2
        for channel in range(3):
            assert gaussian_map.sh[i, 0, channel] == np.float32(v[f"f_dc_{channel}"])
            for k in range(1, coefficients):
                stored = v[f"f_rest_{channel * (coefficients - 1) + k - 1}"]
                assert gaussian_map.sh[i, k, channel] == np.float32(stored)


def test_arrays_are_float32_and_contiguous(tmp_path):
    gaussian_map = load_map(save(tmp_path / "map.ply", stored_values(5, 2)))
    for array in (getattr(gaussian_map, name) for name in ARRAYS):
        assert array.dtype == np.float32
        assert array.flags.c_contiguous


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_encoding_and_order_of_properties_do_not_matter(tmp_path, text, dtype, byte_order):
    values = stored_values(20, 1)
    plain = load_map(save(tmp_path / "plain.ply", values))
    names = list(np.random.default_rng(1).permutation(list(values)))
    shuffled = {name: values[name] for name in names} | {"label": np.arange(20)}
    other = load_map(save(tmp_path / "other.ply", shuffled, dtype, text, byte_order))
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(other, name), getattr(plain, name))


def test_other_elements_round_the_vertices_are_passed_over(tmp_path):
    values = stored_values(7, 0)
    vertex = PlyData.read(str(save(tmp_path / "plain.ply", values)))["vertex"]
    before = PlyElement.describe(np.zeros(3, dtype=[("time", "f8"), ("id", "u1")]), "camera")
    faces = np.empty(2, dtype=[("vertex_indices", "O")])
    faces["vertex_indices"] = [[0, 1, 2], [3, 4, 5, 6]]
    path = tmp_path / "map.ply"
    PlyData([before, vertex, PlyElement.describe(faces, "face")], byte_order="<").write(str(path))
    np.testing.assert_array_equal(load_map(path).means[:, 0], values["x"])


@same_folder
@given(count=st.integers(1, 40), degree=st.integers(0, 3), seed=st.integers(0, 2**32 - 1))
def test_written_map_reads_back(tmp_path, count, degree, seed):
    gaussian_map = random_map(count, degree, seed)
    write_ply(tmp_path / "map.ply", gaussian_map)
    again = load_map(tmp_path / "map.ply")
    np.testing.assert_array_equal(again.means, gaussian_map.means)
    np.testing.assert_array_equal(again.sh, gaussian_map.sh)
    np.testing.assert_allclose(again.scales, gaussian_map.scales, rtol=1e-5)
    np.testing.assert_allclose(again.rotations, gaussian_map.rotations, atol=1e-6)
    np.testing.assert_allclose(again.opacities, gaussian_map.opacities, atol=1e-6)


def test_full_and_no_opacity_are_written_finite(tmp_path):
    gaussian_map = random_map(2, 0, seed=0)
    gaussian_map.opacities[:] = [0.0, 1.0]
    write_ply(tmp_path / "map.ply", gaussian_map)
    np.testing.assert_allclose(load_map(tmp_path / "map.ply").opacities, [0.0, 1.0], atol=1e-6)


def test_written_in_the_order_of_the_trainer(tmp_path):
    write_ply(tmp_path / "map.ply", random_map(3, 3, seed=0))
    written = PlyData.read(str(tmp_path / "map.ply"))["vertex"]
    assert [p.name for p in written.properties] == list(stored_values(1, 3))


# What is wrong with a file, and what the message says


def test_empty_file(tmp_path):
    path = tmp_path / "map.ply"
    path.write_bytes(b"")
    with pytest.raises(MapError, match=r"map\.ply: is an empty file"):
        load_map(path)


def test_no_gaussians(tmp_path):
    with pytest.raises(MapError, match="no Gaussians"):
        load_map(save(tmp_path / "map.ply", stored_values(0, 0)))


def test_no_vertex_element(tmp_path):
    path = tmp_path / "map.ply"
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\nend_header\n")
    with pytest.raises(MapError, match="no element 'vertex'"):
        load_map(path)


def test_missing_file(tmp_path):
    with pytest.raises(MapError, match="No such file"):
        load_map(tmp_path / "nowhere.ply")


def test_pipe(tmp_path):
    os.mkfifo(tmp_path / "map.ply")
    with pytest.raises(MapError, match="is not a file"):
        load_map(tmp_path / "map.ply")


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("keep", [0.3, 0.9, 0.999])
def test_truncated(tmp_path, text, keep):
    path = save(tmp_path / "map.ply", stored_values(100, 0), text=text)
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(MapError, match=r"truncated|damaged"):
        load_map(path)


@pytest.mark.parametrize("text", [False, True])
def test_trailing_bytes_are_no_damage(tmp_path, text):
    values = stored_values(4, 0)
    path = save(tmp_path / "map.ply", values, text=text)
    path.write_bytes(path.read_bytes() + b"\n" * 10)
    gaussian_map = load_map(path)
    np.testing.assert_allclose(gaussian_map.means[:, 0], values["x"])
    assert any("10 bytes" in note for note in gaussian_map.reading.notes) is not text


@pytest.mark.parametrize("text", [False, True])
def test_a_count_that_the_file_cannot_hold_takes_no_memory(tmp_path, text):
    path = save(tmp_path / "map.ply", stored_values(4, 3), text=text)
    path.write_bytes(path.read_bytes().replace(b"vertex 4\n", b"vertex 4000000000000\n"))
    tracemalloc.start()
    with pytest.raises(MapError, match="truncated"):
        load_map(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1e6


@pytest.mark.parametrize("name", ["x", "f_dc_1", "opacity", "scale_0", "rot_3"])
def test_missing_property_is_named(tmp_path, name):
    values = stored_values(4, 0)
    del values[name]
    with pytest.raises(MapError, match=f"lacks {name} "):
        load_map(save(tmp_path / "map.ply", values))


def test_point_cloud(tmp_path):
    values = {name: column for name, column in stored_values(4, 0).items() if name in ("x", "y", "z")}
    with pytest.raises(MapError, match=r"point cloud without Gaussians"):
        load_map(save(tmp_path / "map.ply", values))


def test_2d_gaussian_splatting(tmp_path):
    values = stored_values(4, 0)
    del values["scale_2"]
    with pytest.raises(MapError, match="2DGS"):
        load_map(save(tmp_path / "map.ply", values))


def rgb_values(count: int, dtype: str) -> dict[str, np.ndarray]:
    """Stored values with RGB in place of harmonics, as nerfstudio exports them with --ply-color-mode rgb."""
    values = {name: column for name, column in stored_values(count, 0).items() if not name.startswith("f_dc")}
    return values | {name: np.arange(count).astype(dtype) for name in ("red", "green", "blue")}


def test_colours_as_bytes_are_the_same_from_all_sides(tmp_path):
    gaussian_map = load_map(save(tmp_path / "map.ply", rgb_values(250, "u1"), dtype=None))
    np.testing.assert_allclose(gaussian_map.sh[:, 0, 1] * SH_C0 + 0.5, np.arange(250) / 255, atol=1e-6)
    assert any("RGB" in note for note in gaussian_map.reading.notes)


def test_colours_of_another_type_are_refused(tmp_path):
    with pytest.raises(MapError, match="no bytes"):
        load_map(save(tmp_path / "map.ply", rgb_values(4, "f4"), dtype=None))


@pytest.mark.parametrize(
    ("comments", "antialiased"),
    [
        ([], False),
        (["Generated by Brush", "SplatRenderMode: mip"], True),
        (["SplatRenderMode: default"], False),
        (["antialiased 1"], True),
        (["antialiased 0"], False),
        (["postshot.anti_aliasing=1"], True),
        (["postshot.anti_aliasing=0"], False),
        (["antialiased 1", "SplatRenderMode: default"], False),
    ],
)
def test_comment_that_tells_of_antialiased_training(tmp_path, comments, antialiased):
    vertex = PlyData.read(str(save(tmp_path / "plain.ply", stored_values(3, 0))))["vertex"]
    PlyData([vertex], byte_order="<", comments=comments).write(str(tmp_path / "map.ply"))
    assert load_map(tmp_path / "map.ply").antialiased is antialiased


def test_antialiased_training_is_written(tmp_path):
    write_ply(tmp_path / "map.ply", replace(random_map(3, 0, seed=0), antialiased=True))
    assert load_map(tmp_path / "map.ply").antialiased


def test_comment_that_tells_of_2d_gaussian_splatting(tmp_path):
    vertex = PlyData.read(str(save(tmp_path / "plain.ply", stored_values(3, 0))))["vertex"]
    PlyData([vertex], byte_order="<", comments=["SplatRenderMode: 2dgs"]).write(str(tmp_path / "map.ply"))
    with pytest.raises(MapError, match="2DGS"):
        load_map(tmp_path / "map.ply")


def test_reading_takes_no_second_copy_of_the_map(tmp_path):
    write_ply(tmp_path / "map.ply", random_map(100_000, 3, seed=0))
    tracemalloc.start()
    gaussian_map = load_map(tmp_path / "map.ply")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.4 * sum(getattr(gaussian_map, name).nbytes for name in ARRAYS)


@pytest.mark.parametrize("count", [1, 8, 10, 73])
def test_wrong_number_of_harmonics(tmp_path, count):
    values = stored_values(4, 0) | {f"f_rest_{i}": np.zeros(4) for i in range(count)}
    with pytest.raises(MapError, match=f"has {count} f_rest"):
        load_map(save(tmp_path / "map.ply", values))


def test_gap_in_the_harmonics(tmp_path):
    values = stored_values(4, 1)
    values["f_rest_9"] = values.pop("f_rest_3")
    with pytest.raises(MapError, match="f_rest"):
        load_map(save(tmp_path / "map.ply", values))


def test_list_property_in_vertex(tmp_path):
    path = save(tmp_path / "map.ply", stored_values(4, 0))
    path.write_bytes(path.read_bytes().replace(b"property float nx", b"property list uchar float nx"))
    with pytest.raises(MapError, match=r"list properties \(nx\)"):
        load_map(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, value) for name in ("y", "f_dc_2", "f_rest_4", "rot_0") for value in (np.nan, np.inf, -np.inf)),
        *(("opacity", np.nan), ("scale_1", np.nan), ("scale_1", np.inf)),
    ],
)
def test_values_that_are_not_finite_are_counted(tmp_path, name, value):
    values = stored_values(10, 1)
    values[name][[3, 7]] = value
    with pytest.raises(MapError, match=r"2 of 10 Gaussians.*number 3"):
        load_map(save(tmp_path / "map.ply", values))


def test_scale_that_overflows_is_counted(tmp_path):
    values = stored_values(10, 0)
    values["scale_2"][9] = 89.0  # e^89 > 3.4e38
    with pytest.raises(MapError, match=r"1 of 10 Gaussians.*number 9"):
        load_map(save(tmp_path / "map.ply", values))


def test_double_that_overflows_is_counted(tmp_path):
    values = {name: column.astype(np.float64) for name, column in stored_values(10, 0).items()}
    values["z"][2] = 1e300
    with pytest.raises(MapError, match=r"1 of 10 Gaussians.*number 2"):
        load_map(save(tmp_path / "map.ply", values, dtype="f8"))


def test_scale_that_underflows_stays_positive(tmp_path):
    values = stored_values(3, 0)
    values["scale_1"][:] = -1000.0
    assert (load_map(save(tmp_path / "map.ply", values)).scales > 0).all()


def test_quaternion_of_zero_length(tmp_path):
    values = stored_values(10, 0)
    for k in range(4):
        values[f"rot_{k}"][4] = 0.0
    with pytest.raises(MapError, match=r"1 of 10 Gaussians.*quaternion.*number 4"):
        load_map(save(tmp_path / "map.ply", values))


# Any damage gives a MapError or a valid map


@same_folder
@given(data=st.data(), text=st.booleans())
def test_random_truncation(tmp_path, data, text):
    path = save(tmp_path / "map.ply", stored_values(12, 1), text=text)
    content = path.read_bytes()
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    check_damaged(path, 2e6)


@settings(same_folder, max_examples=300)
@given(data=st.data(), text=st.booleans())
def test_random_bytes_in_the_header(tmp_path, data, text):
    path = save(tmp_path / "map.ply", stored_values(12, 1), text=text)
    content = bytearray(path.read_bytes())
    header_size = content.index(b"end_header\n") + len(b"end_header\n")
    positions = st.integers(0, header_size - 1)
    # Digits and letters as well as any byte: they get further into the parser.
    byte = st.one_of(st.integers(0, 255), st.sampled_from(list(b"0123456789-. \nxyz")))
    for position, value in data.draw(st.lists(st.tuples(positions, byte), min_size=1, max_size=4)):
        content[position] = value
    path.write_bytes(bytes(content))
    check_damaged(path, 2e6)


@same_folder
@given(data=st.data())
def test_random_bytes_in_the_values(tmp_path, data):
    path = save(tmp_path / "map.ply", stored_values(12, 1))
    content = bytearray(path.read_bytes())
    start = content.index(b"end_header\n") + len(b"end_header\n")
    bits = st.tuples(st.integers(start, len(content) - 4), st.integers(0, 2**32 - 1))
    for position, value in data.draw(st.lists(bits, min_size=1, max_size=4)):
        content[position : position + 4] = struct.pack("<I", value)
    path.write_bytes(bytes(content))
    check_damaged(path, 2e6)


HEADER_LINES = [
    "format ascii 1.0",
    "format binary_little_endian 1.0",
    "comment a",
    "obj_info b",
    "element vertex 3",
    "element vertex -1",
    "element face 99999999999",
    "property float x",
    "property list uchar int i",
    "property half y",
    "property",
    "element",
    "end_header",
    "",
    "é",
]


@same_folder
@given(lines=st.lists(st.sampled_from(HEADER_LINES), max_size=12))
def test_random_header_lines(tmp_path, lines):
    path = tmp_path / "map.ply"
    path.write_text("\n".join(["ply", *lines, ""]), encoding="utf-8")
    check_damaged(path, 2e6)
