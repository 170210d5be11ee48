"""The GPU renderer: what it asks of gsplat, against the slow reference, and what is said where it cannot run.

Without a GPU a stand-in for gsplat is drawn with, by gsplat's documentation, on the CPU (stand_in/gsplat.py). That
shows what this package makes of poses, cameras, harmonics and depths; not that gsplat does as documented. `make gsplat`
shows that: it puts gsplat's own kernels, compiled for the CPU (cuda_on_cpu/), in the stand-in's place. With a GPU and
gsplat the last tests show that it does so there.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import subprocess
import sys
import threading
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from cuda_on_cpu.gsplat_on_cpu import import_on_cpu
from hypothesis import given
from hypothesis import strategies as st
from small_maps import assert_same, concatenated, one_gaussian, psnr, random_map, small_camera
from stand_in.gpu import SimulatedGpu, as_kernel, simulated_gpu

from gsfeatloc_ros.benchmark.frames import measure_frames
from gsfeatloc_ros.common.device import choose_device, explain_fallback, gpu_problem
from gsfeatloc_ros.common.geometry import make_pose, so3_exp
from gsfeatloc_ros.maps import GaussianMap, Similarity
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS
from gsfeatloc_ros.render import DrawOptions, create_renderer
from gsfeatloc_ros.render.base import DEFAULT_DRAW_OPTIONS
from gsfeatloc_ros.render.cpu import CpuRenderer
from gsfeatloc_ros.render.depth_bins import DepthBins
from gsfeatloc_ros.render.gpu import GpuRenderer, self_check
from gsfeatloc_ros.render.prepare import prepare
from gsfeatloc_ros.render.reference import ReferenceRenderer

STAND_IN = Path(__file__).parents[1] / "support" / "stand_in" / "gsplat.py"
# Where gsplat is installed whose kernels are to be drawn with on the CPU.
GSPLAT_ON_CPU = os.environ.get("GSPLAT_ON_CPU")
FUNCTIONS = (
    "fully_fused_projection", "isect_offset_encode", "isect_tiles", "rasterize_to_pixels", "spherical_harmonics",
)  # fmt: skip
POSE = make_pose(so3_exp(np.array([0.2, -0.3, 0.1])), np.array([0.3, -0.2, 0.5]))
BACKGROUND = (0.2, 0.4, 0.6)
on_gpu = pytest.mark.skipif(
    not (torch.cuda.is_available() and importlib.util.find_spec("gsplat")), reason="no CUDA device with gsplat here"
)


def forget() -> None:
    for function in (self_check, gpu_problem, explain_fallback):
        function.cache_clear()


@pytest.fixture
def gsplat(monkeypatch) -> ModuleType:
    """The stand-in, in place of gsplat, or gsplat itself on the CPU."""
    if GSPLAT_ON_CPU:
        module = import_on_cpu(Path(GSPLAT_ON_CPU))
    else:
        spec = importlib.util.spec_from_file_location("gsplat", STAND_IN)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    forget()
    yield module
    forget()


@pytest.fixture
def no_gsplat(monkeypatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    forget()
    yield
    forget()


def on_stand_in(gaussian_map: GaussianMap, options: DrawOptions = DEFAULT_DRAW_OPTIONS) -> GpuRenderer:
    return GpuRenderer(gaussian_map, options, device="cpu")


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("antialiased", [False, True])
def test_asks_for_the_picture_that_the_reference_draws(gsplat, sh_degree: int, antialiased: bool) -> None:
    gaussian_map = replace(random_map(150, sh_degree, seed=sh_degree), antialiased=antialiased)
    gpu = on_stand_in(gaussian_map, DrawOptions(BACKGROUND)).render(small_camera(), POSE).on_host()
    reference = ReferenceRenderer(gaussian_map, BACKGROUND).render(small_camera(), POSE)
    assert_same(gpu, reference, 70)
    for image in (gpu.rgb, gpu.depth, gpu.median_depth, gpu.depth_std, gpu.alpha):
        assert image.dtype == np.float32
        assert image.flags.writeable
    no_depth = np.isnan(gpu.depth)
    assert 0 < no_depth.sum() < no_depth.size
    for image in (gpu.median_depth, gpu.depth_std):
        np.testing.assert_array_equal(np.isnan(image), no_depth)
    np.testing.assert_array_equal(no_depth, gpu.alpha < 0.5)


def test_a_map_moved_turned_and_scaled_looks_alike_and_its_depths_are_the_maps(gsplat) -> None:
    gaussian_map = random_map(300, 2, seed=3)
    S_map_splat = Similarity(2.5, so3_exp(np.array([0.4, 0.2, -1.0])), np.array([10.0, -4.0, 3.0]))
    moved = replace(gaussian_map, S_map_splat=S_map_splat)
    here = on_stand_in(gaussian_map).render(small_camera(), POSE).on_host()
    there = on_stand_in(moved).render(small_camera(), S_map_splat.transform_pose(POSE)).on_host()
    assert psnr(here, there) > 70
    assert_same(there, ReferenceRenderer(moved).render(small_camera(), S_map_splat.transform_pose(POSE)), 70)
    np.testing.assert_allclose(there.depth, 2.5 * here.depth, rtol=1e-4)


def test_a_map_far_from_its_origin_loses_no_digits(gsplat) -> None:
    # Steps of float32 at 65536 are 1/128: on that grid the map itself is exact, and so is the picture to be.
    near = random_map(200, 1, seed=5)
    near = replace(near, means=np.round(near.means * 128) / 128)
    far = replace(near, means=near.means + np.float32([65536, -65536, 0]))
    pose = POSE.copy()
    pose[:3, 3] += [65536, -65536, 0]
    a, b = (
        on_stand_in(near).render(small_camera(), POSE).on_host(),
        on_stand_in(far).render(small_camera(), pose).on_host(),
    )
    assert psnr(a, b) > 70


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_harmonics_are_drawn_up_to_the_degree_asked_for(gsplat, sh_degree: int) -> None:
    gaussian_map = random_map(200, 2, seed=7)
    cut = replace(gaussian_map, sh=gaussian_map.sh[:, : SH_COEFFICIENTS[sh_degree]])
    capped = on_stand_in(gaussian_map, DrawOptions(sh_degree=sh_degree)).render(small_camera(), np.eye(4)).on_host()
    np.testing.assert_array_equal(capped.rgb, on_stand_in(cut).render(small_camera(), np.eye(4)).on_host().rgb)


def test_median_depth_ignores_a_floater_that_drags_the_mean(gsplat) -> None:
    wall = one_gaussian((0, 0, 4.0), (30.0, 30.0, 1e-3), 0.99)
    floater = one_gaussian((0, 0, 1.0), (30.0, 30.0, 1e-3), 0.3)
    render = on_stand_in(concatenated(wall, floater)).render(small_camera(), np.eye(4)).on_host()
    middle = render.depth.shape[0] // 2, render.depth.shape[1] // 2
    assert render.median_depth[middle] == pytest.approx(4.0, abs=1e-3)
    assert render.depth[middle] < 3.2


def test_median_depth_is_close_to_the_exact_one(gsplat, room_map, room_photos) -> None:
    photo = room_photos[0]
    camera = replace(small_camera(60, 45), K=np.array([[47.0, 0, 29.5], [0, 47.0, 22.0], [0, 0, 1]]))
    estimate = on_stand_in(room_map).render(camera, photo.T_map_camera).on_host()
    exact = CpuRenderer(room_map).render(camera, photo.T_map_camera)
    covered = exact.alpha > 0.8
    assert covered.mean() > 0.5
    error = np.abs(estimate.median_depth - exact.median_depth)[covered] / exact.median_depth[covered]
    assert np.quantile(error, 0.5) < 0.005
    assert np.quantile(error, 0.95) < 0.03


@given(st.integers(0, 10_000), st.integers(1, 40), st.sampled_from([1.0, 1e3, 1e9]))
def test_median_depth_is_among_the_depths(seed: int, count: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    depths = torch.from_numpy(rng.uniform(1.0, 2.0, count) * spread ** rng.uniform(0, 1, count)).float()
    weights = torch.from_numpy(rng.dirichlet(np.ones(count))).float()
    bins = DepthBins.of(depths, torch.from_numpy(rng.integers(1, 500, count)))
    median = bins.statistics((weights @ bins.channels(depths))[None, None])[1].item()
    # Between the edges of the bin that holds the exact one.
    order = depths.argsort()
    exact = depths[order][(weights[order].cumsum(0) >= 0.5 - 1e-5).int().argmax()].item()
    edges = [0.0, *bins.edges.tolist(), np.inf]
    assert any(
        low <= median <= high and low <= 1.0001 * exact and exact <= 1.0001 * high for low, high in pairwise(edges)
    )


@pytest.mark.parametrize("gaussian_map", [random_map(0, 1, seed=0), one_gaussian((0, 0, -2), 0.1, 1.0)])
def test_where_there_is_nothing_to_see_there_is_the_background(gsplat, gaussian_map) -> None:
    render = on_stand_in(gaussian_map, DrawOptions(BACKGROUND)).render(small_camera(), np.eye(4)).on_host()
    np.testing.assert_array_equal(render.rgb, np.broadcast_to(np.float32(BACKGROUND), render.rgb.shape))
    np.testing.assert_array_equal(render.alpha, 0)
    assert np.isnan(render.depth).all()
    assert np.isnan(render.median_depth).all()
    assert np.isnan(render.depth_std).all()


def test_a_prepared_map_and_a_smaller_picture_are_drawn_as_by_the_cpu(gsplat) -> None:
    gaussian_map = random_map(300, 1, seed=2)
    whole = on_stand_in(gaussian_map).render(small_camera(), POSE).on_host()
    np.testing.assert_array_equal(
        on_stand_in(prepare(gaussian_map)).render(small_camera(), POSE).on_host().rgb, whole.rgb
    )
    half = DrawOptions(resolution_scale=0.5)
    small = on_stand_in(gaussian_map, half).render(small_camera(), POSE).on_host()
    assert psnr(small, CpuRenderer(gaussian_map, options=half).render(small_camera(), POSE)) > 70


def test_threads_get_the_same_pictures(gsplat) -> None:
    renderer = on_stand_in(random_map(150, 1, seed=1))
    poses = [make_pose(so3_exp(np.array([0.0, 0.1 * k, 0.0])), np.zeros(3)) for k in range(4)]
    alone = [renderer.render(small_camera(), pose).on_host() for pose in poses]
    together = [None] * len(poses)

    def draw(k: int) -> None:
        together[k] = renderer.render(small_camera(), poses[k]).on_host()

    threads = [threading.Thread(target=draw, args=(k,)) for k in range(len(poses))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.median_depth, b.median_depth)


@pytest.fixture
def gpu(gsplat, monkeypatch) -> SimulatedGpu:
    """A simulated GPU, on which gsplat draws."""
    for name in FUNCTIONS:
        monkeypatch.setattr(gsplat, name, as_kernel(getattr(gsplat, name)))
    with simulated_gpu() as gpu:
        yield gpu


def test_a_render_is_made_and_stays_on_the_gpu(gpu) -> None:
    gaussian_map = random_map(150, 1, seed=0)
    renderer = GpuRenderer(gaussian_map, device=gpu.device)
    gpu.reset()
    render = renderer.render(small_camera(), POSE)
    assert not gpu.to_host, gpu.explain()
    # Where the camera is goes there, and nobody waits.
    assert not gpu.waits, gpu.explain()
    assert 0 < sum(gpu.to_device) < 200, gpu.explain()
    assert_same(render.on_host(), CpuRenderer(gaussian_map).render(small_camera(), POSE), 70)


def test_a_picture_drawn_small_is_enlarged_on_the_gpu(gpu) -> None:
    gaussian_map = random_map(150, 1, seed=0)
    half = DrawOptions(resolution_scale=0.5)
    renderer = GpuRenderer(gaussian_map, half, gpu.device)
    gpu.reset()
    render = renderer.render(small_camera(), POSE)
    pictures = {name: getattr(render, name) for name in ("rgb", "depth", "median_depth", "depth_std", "alpha")}
    for name, picture in pictures.items():
        assert (picture.device.type, picture.dtype) == (gpu.device, torch.float32), name
    assert (gpu.to_host, gpu.waits) == ([], []), gpu.explain()
    assert_same(render.on_host(), CpuRenderer(gaussian_map, options=half).render(small_camera(), POSE), 70)


def test_frames_are_measured_by_stage_when_the_gpu_is_done(gpu, monkeypatch) -> None:
    done = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: done.append(True))
    renderer = GpuRenderer(random_map(150, 1, seed=0), device=gpu.device)
    report = measure_frames(renderer, small_camera(), [POSE] * 3)
    assert list(report["stages_wall_ms"]) == ["project", "colour", "tiles and sort", "blend"]
    assert all(milliseconds > 0 for milliseconds in report["stages_wall_ms"].values())
    assert report["coverage"] > 0.1
    # Each frame, and each stage before and after.
    assert len(done) >= 3 + 3 * 2 * 4


def mirrored(call, means, covars, **options):
    return call(
        means=means * torch.tensor([-1.0, 1.0, 1.0]), covars=covars * torch.tensor([1.0, -1, -1, 1, 1, 1]), **options
    )


def half_a_pixel_off(call, Ks, **options):
    return call(Ks=Ks + 0.5 * torch.tensor([[0, 0, 1], [0, 0, 1], [0, 0, 0]]), **options)


def harmonics_left_out(call, degrees_to_use, **options):
    return call(degrees_to_use=min(degrees_to_use, 2), **options)


def not_antialiased(call, **options):
    *splats, compensations = call(**options)
    return *splats, None if compensations is None else torch.ones_like(compensations)


def not_a_number(call, *arguments, **options):
    colors, alphas = call(*arguments, **options)
    return colors * torch.nan, alphas


def far_off(call, **options):
    *before, depths, conics, compensations = call(**options)
    return *before, 1.01 * depths, conics, compensations


def broken(call, **options):
    raise AttributeError("'NoneType' object has no attribute 'PINHOLE'")


@pytest.mark.parametrize(
    ("function", "damage", "reason"),
    [
        ("fully_fused_projection", mirrored, r"wrong pictures.* dB"),
        ("fully_fused_projection", half_a_pixel_off, r"wrong pictures.* dB"),
        ("spherical_harmonics", harmonics_left_out, r"wrong pictures.* dB"),
        ("fully_fused_projection", not_antialiased, r"wrong pictures.* dB"),
        ("rasterize_to_pixels", not_a_number, r"wrong pictures.*nan dB"),
        ("fully_fused_projection", far_off, r"wrong pictures.*depth is off"),
        ("fully_fused_projection", broken, r"does not work.*PINHOLE.*nvcc"),
    ],
)
def test_a_gsplat_that_draws_otherwise_is_refused(gsplat, monkeypatch, function, damage, reason) -> None:
    monkeypatch.setattr(gsplat, function, partial(damage, getattr(gsplat, function)))
    with pytest.raises(RuntimeError, match=reason):
        on_stand_in(one_gaussian((0, 0, 2), 0.1, 1.0))


def test_without_gsplat_cuda_is_refused_with_what_to_install(no_gsplat) -> None:
    with pytest.raises(RuntimeError, match=r"device cuda: gsplat is not installed: pip install"):
        create_renderer(one_gaussian((0, 0, 2), 0.1, 1.0), "cuda")


def test_without_gsplat_auto_is_the_cpu_and_says_so_once(no_gsplat, caplog) -> None:
    caplog.set_level(logging.INFO)
    for _ in range(2):
        assert isinstance(create_renderer(one_gaussian((0, 0, 2), 0.1, 1.0), "auto"), CpuRenderer)
    assert [record.getMessage() for record in caplog.records] == [f"rendering on the CPU: {gpu_problem()}"]


def test_without_gsplat_auto_does_not_load_torch() -> None:
    code = """
import importlib.util, sys
find_spec = importlib.util.find_spec
importlib.util.find_spec = lambda name, *more: None if name == "gsplat" else find_spec(name, *more)
from gsfeatloc_ros.maps import load_map
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.render import DrawOptions, create_renderer
import numpy as np
one = GaussianMap(*(np.ones((1, *shape), np.float32) for shape in ((3,), (3,), (4,), (), (1, 3))))
create_renderer(one)
assert "torch" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.mark.parametrize(
    ("version", "reason"), [(None, "build without CUDA"), ("12.8", "finds no CUDA device: see whether nvidia-smi")]
)
def test_without_cuda_the_reason_is_told(gsplat, monkeypatch, caplog, version, reason) -> None:
    monkeypatch.setattr(torch.version, "cuda", version)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(RuntimeError, match=f"device cuda: torch .*{reason}"):
        create_renderer(one_gaussian((0, 0, 2), 0.1, 1.0), "cuda")
    assert isinstance(create_renderer(one_gaussian((0, 0, 2), 0.1, 1.0), "auto"), CpuRenderer)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert reason in caplog.text


def test_a_gpu_that_draws_otherwise_is_no_choice_of_auto(gsplat, monkeypatch, caplog) -> None:
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gsplat, "fully_fused_projection", broken)
    # Nothing is known against it below the renderers: matchers may use it.
    assert choose_device("auto") == "cuda"
    with pytest.raises(RuntimeError, match=r"device cuda: gsplat does not work"):
        create_renderer(one_gaussian((0, 0, 2), 0.1, 1.0), "cuda")
    assert isinstance(create_renderer(one_gaussian((0, 0, 2), 0.1, 1.0), "auto"), CpuRenderer)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "rendering on the CPU: gsplat does not work" in caplog.text


@on_gpu
@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_draws_the_picture_that_the_reference_draws(sh_degree: int, antialiased: bool) -> None:
    gaussian_map = replace(random_map(800, sh_degree, seed=sh_degree), antialiased=antialiased)
    gpu = create_renderer(gaussian_map, "cuda", options=DrawOptions(BACKGROUND)).render(small_camera(), POSE).on_host()
    assert_same(gpu, ReferenceRenderer(gaussian_map, BACKGROUND).render(small_camera(), POSE), 60)


@on_gpu
def test_gsplat_draws_the_same_each_time(room_map, room_camera, room_photos) -> None:
    renderer = create_renderer(room_map, "auto")
    assert isinstance(renderer, GpuRenderer)
    a, b = (renderer.render(room_camera, room_photos[0].T_map_camera).on_host() for _ in range(2))
    for name in ("rgb", "depth", "median_depth", "depth_std", "alpha"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@on_gpu
@pytest.mark.parametrize("gaussian_map", [random_map(0, 1, seed=0), one_gaussian((0, 0, -2), 0.1, 1.0)])
def test_gsplat_draws_nothing_where_there_is_nothing(gaussian_map) -> None:
    render = (
        create_renderer(gaussian_map, "cuda", options=DrawOptions(BACKGROUND))
        .render(small_camera(), np.eye(4))
        .on_host()
    )
    np.testing.assert_array_equal(render.rgb, np.broadcast_to(np.float32(BACKGROUND), render.rgb.shape))


@on_gpu
def test_gsplat_sees_the_room_as_the_cpu_does(room_map, room_camera, room_photos) -> None:
    pose = room_photos[0].T_map_camera
    gpu = create_renderer(room_map, "cuda").render(room_camera, pose).on_host()
    cpu = create_renderer(room_map, "cpu").render(room_camera, pose)
    assert_same(gpu, cpu, 60)
    error = np.abs(gpu.median_depth - cpu.median_depth) / cpu.median_depth
    assert np.nanquantile(error, 0.5) < 0.005
