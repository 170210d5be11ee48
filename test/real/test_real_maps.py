"""Maps as trainers and the tools of others wrote them."""

from __future__ import annotations

import shutil
import tracemalloc

import numpy as np
import pytest
from map_files import ARRAYS
from plyfile import PlyData
from small_maps import assert_same

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.maps import GaussianMap, load_map
from gsfeatloc_ros.render import DrawOptions, create_renderer
from gsfeatloc_ros.render.reference import ReferenceRenderer


@pytest.mark.parametrize(
    ("name", "count", "degree"),
    [("scenes/bonsai/map.ply", 68914, 1), ("scenes/lego/map.ply", 69238, 1), ("maps/plush_dog.ply", 15105, 3)],
)
def test_ply_of_a_trainer(real_file, name, count, degree):
    gaussian_map = load_map(real_file(name))
    assert len(gaussian_map) == count
    assert gaussian_map.sh_degree == degree
    stored = PlyData.read(str(real_file(name)))["vertex"]
    np.testing.assert_allclose(gaussian_map.scales[:, 2], np.exp(stored["scale_2"]), rtol=1e-5)
    np.testing.assert_array_equal(gaussian_map.sh[:, 1, 1], stored[f"f_rest_{(degree + 1) ** 2 - 1}"])


def views(gaussian_map: GaussianMap, count: int) -> list[np.ndarray]:
    """Return poses (4, 4) of a camera that goes round a thing upright in the map and looks at it."""
    center = np.median(gaussian_map.means, axis=0).astype(np.float64)
    radius = 2.0 * np.quantile(np.linalg.norm(gaussian_map.means - center, axis=1), 0.95)
    turns = [so3_exp(np.array([0.0, 2 * np.pi * k / count, 0.0])) for k in range(count)]
    return [make_pose(turn, center - radius * turn[:, 2]) for turn in turns]


@pytest.mark.parametrize(
    ("one", "other", "decibels"),
    [("plush_dog.ply", "plush_dog.compressed.ply", 38.0), ("biker.compressed.ply", "biker.spz", 46.0)],
)
def test_two_formats_of_a_scene_render_alike(maps, one, other, decibels):
    a, b = load_map(maps / one), load_map(maps / other)
    assert len(a) == len(b)
    camera = Camera(240, 240, np.array([[240.0, 0, 119.5], [0, 240.0, 119.5], [0, 0, 1]]))
    for pose in views(a, 4):
        x, y = (create_renderer(m, options=DrawOptions((0.5, 0.5, 0.5))).render(camera, pose) for m in (a, b))
        seen = x.alpha > 0.1
        assert seen.mean() > 0.03
        assert -10 * np.log10(np.mean((x.rgb[seen].astype(np.float64) - y.rgb[seen]) ** 2)) > decibels
        both = np.isfinite(x.depth) & np.isfinite(y.depth)
        assert np.quantile(np.abs(x.depth - y.depth)[both] / x.depth[both], 0.99) < 0.01


def test_real_sog(maps):
    gaussian_map = load_map(maps / "playbot.sog")
    assert len(gaussian_map) == 31000
    assert gaussian_map.sh_degree == 2
    # A robot that stands on the ground at the origin, one unit high; y points down, as in .ply.
    np.testing.assert_allclose(gaussian_map.means[:, 1].min(), -1.08, atol=0.01)
    np.testing.assert_allclose(gaussian_map.means[:, 1].max(), 0.04, atol=0.01)


def test_real_splat(maps):
    gaussian_map = load_map(maps / "plant.splat")
    assert len(gaussian_map) == 113_648
    image = create_renderer(gaussian_map).render(
        Camera(200, 200, np.array([[200.0, 0, 99.5], [0, 200.0, 99.5], [0, 0, 1]])), views(gaussian_map, 1)[0]
    )
    # Green leaves above a light pot.
    top, bottom = (image.rgb[rows][image.alpha[rows] > 0.8].mean(axis=0) for rows in (slice(20, 90), slice(130, 190)))
    assert top[1] == top.max()
    assert bottom.mean() > 1.5 * top.mean()


@pytest.mark.parametrize("name", ["plush_dog.compressed.ply", "biker.compressed.ply", "biker.spz", "plant.splat"])
def test_the_name_does_not_matter(maps, tmp_path, name):
    shutil.copy(maps / name, tmp_path / "map.dat")
    assert len(load_map(tmp_path / "map.dat")) == len(load_map(maps / name))


@pytest.mark.parametrize(
    "name", ["plush_dog.ply", "plush_dog.compressed.ply", "biker.compressed.ply", "biker.spz", "plant.splat"]
)
def test_reading_takes_no_second_copy_of_the_map(maps, name):
    tracemalloc.start()
    gaussian_map = load_map(maps / name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    block = 8192 * 4 * 200  # of temporary values, which matter in small maps alone
    arrays = sum(getattr(gaussian_map, name).nbytes for name in ARRAYS)
    assert peak < 1.6 * arrays + block


@pytest.mark.parametrize("name", ["scenes/bonsai/map.ply", "scenes/lego/map.ply", "maps/plush_dog.ply"])
def test_the_cpu_renders_as_the_reference(real_file, name):
    gaussian_map = load_map(real_file(name))
    # From outside, looking at the middle of the map, and from within it.
    center = np.median(gaussian_map.means, axis=0).astype(np.float64)
    extent = np.quantile(np.linalg.norm(gaussian_map.means - center, axis=1), 0.7)
    camera = Camera(160, 120, np.array([[130.0, 0, 79.5], [0, 130.0, 59.5], [0, 0, 1]]))
    for pose in (make_pose(np.eye(3), center - [0, 0, 2.0 * extent]), make_pose(so3_exp(np.ones(3)), center)):
        fast = create_renderer(gaussian_map, device="cpu").render(camera, pose)
        assert_same(fast, ReferenceRenderer(gaussian_map).render(camera, pose), 70)
