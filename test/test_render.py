"""The CPU renderer against the slow reference, and both against closed forms."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsfeatloc_ros.camera import Camera
from gsfeatloc_ros.geometry import make_pose, so3_exp
from gsfeatloc_ros.maps import GaussianMap, load_map
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS
from gsfeatloc_ros.render import Render, create_renderer
from gsfeatloc_ros.render.reference import ReferenceRenderer

SH_C0 = 0.28209479177387814


def random_map(count: int, sh_degree: int, seed: int) -> GaussianMap:
    """Gaussians of many sizes, shapes and opacities, 1 to 6 units ahead of and a little behind the origin."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(count, 4))
    sh = rng.normal(scale=0.3, size=(count, SH_COEFFICIENTS[sh_degree], 3))
    return GaussianMap(
        means=rng.uniform([-3, -2, -1], [3, 2, 6], (count, 3)).astype(np.float32),
        scales=np.exp(rng.uniform(-6, -0.5, (count, 3))).astype(np.float32),
        rotations=(rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        opacities=rng.uniform(0, 1, count).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def one_gaussian(mean, scale, opacity: float, color=(0.9, 0.5, 0.1)) -> GaussianMap:
    """A map of one axis-aligned Gaussian of one colour."""
    return GaussianMap(
        means=np.array([mean], dtype=np.float32),
        scales=np.broadcast_to(np.float32(scale), (1, 3)).copy(),
        rotations=np.array([[1, 0, 0, 0]], dtype=np.float32),
        opacities=np.array([opacity], dtype=np.float32),
        sh=((np.array(color, dtype=np.float32) - 0.5) / SH_C0).reshape(1, 1, 3),
    )


def concatenated(*maps: GaussianMap) -> GaussianMap:
    fields = ("means", "scales", "rotations", "opacities", "sh")
    return GaussianMap(**{field: np.concatenate([getattr(m, field) for m in maps]) for field in fields})


def small_camera(width: int = 75, height: int = 53) -> Camera:
    """A camera whose size is no multiple of the tile's, with its centre off the middle and unequal focal lengths."""
    return Camera(width, height, np.array([[70.0, 0, 0.45 * width], [0, 66.0, 0.52 * height], [0, 0, 1]]))


def psnr(a: Render, b: Render) -> float:
    return -10 * np.log10(np.mean((a.rgb.astype(np.float64) - b.rgb) ** 2) + 1e-20)


def assert_same(fast: Render, reference: Render, decibels: float) -> None:
    assert psnr(fast, reference) >= decibels
    np.testing.assert_allclose(fast.alpha, reference.alpha, atol=5e-3)
    both = np.isfinite(fast.depth) & np.isfinite(reference.depth)
    # Where alpha is at the limit, rounding decides whether there is a depth.
    assert np.mean(np.isfinite(fast.depth) == np.isfinite(reference.depth)) > 0.999
    if both.any():
        error = np.abs(fast.depth - reference.depth)[both] / reference.depth[both]
        assert np.median(error) <= 1e-4
        assert np.quantile(error, 0.999) <= 1e-3
        spread_error = np.abs(fast.depth_std - reference.depth_std)[both] / reference.depth[both]
        assert np.quantile(spread_error, 0.99) <= 1e-3


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_agrees_with_the_reference_at_every_sh_degree(sh_degree: int) -> None:
    gaussian_map = random_map(800, sh_degree, seed=sh_degree)
    pose = make_pose(so3_exp(np.array([0.2, -0.3, 0.1])), np.array([0.3, -0.2, 0.5]))
    camera = small_camera()
    fast = create_renderer(gaussian_map, background=(0.2, 0.4, 0.6)).render(camera, pose)
    assert_same(fast, ReferenceRenderer(gaussian_map, (0.2, 0.4, 0.6)).render(camera, pose), 70)


@pytest.mark.parametrize("scene", ["scenes/bonsai/map.ply", "scenes/lego/map.ply", "maps/plush_dog.ply"])
def test_agrees_with_the_reference_on_real_maps(shared, scene: str) -> None:
    gaussian_map = load_map(shared / scene)
    # From outside, looking at the middle of the map, and from within it.
    center = np.median(gaussian_map.means, axis=0).astype(np.float64)
    extent = np.quantile(np.linalg.norm(gaussian_map.means - center, axis=1), 0.7)
    camera = Camera(160, 120, np.array([[130.0, 0, 79.5], [0, 130.0, 59.5], [0, 0, 1]]))
    for pose in (make_pose(np.eye(3), center - [0, 0, 2.0 * extent]), make_pose(so3_exp(np.ones(3)), center)):
        fast = create_renderer(gaussian_map).render(camera, pose)
        assert_same(fast, ReferenceRenderer(gaussian_map).render(camera, pose), 60)


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    threads=st.integers(1, 3),
    width=st.integers(1, 70),
    height=st.integers(1, 40),
)
def test_agrees_with_the_reference_on_any_size_and_thread_count(seed, threads, width, height) -> None:
    gaussian_map = random_map(60, 1, seed)
    camera = small_camera(width, height)
    fast = create_renderer(gaussian_map, threads=threads).render(camera, np.eye(4))
    assert_same(fast, ReferenceRenderer(gaussian_map).render(camera, np.eye(4)), 60)


def test_a_gaussian_is_drawn_where_the_camera_projects_its_centre() -> None:
    camera = small_camera()
    render = create_renderer(one_gaussian((0.4, -0.3, 2.0), 0.01, 1.0)).render(camera, np.eye(4))
    weight = render.alpha / render.alpha.sum()
    y, x = np.mgrid[: camera.height, : camera.width]
    expected = camera.project(np.array([[0.4, -0.3, 2.0]]))[0]
    # Alpha under 1/255 is cut, pixel by pixel: the centroid is exact to a hundredth.
    np.testing.assert_allclose([(weight * x).sum(), (weight * y).sum()], expected, atol=0.02)


def test_depth_and_spread_of_two_layers_are_their_weighted_mean_and_deviation() -> None:
    front, back = one_gaussian((0, 0, 2.0), 1.0, 0.5), one_gaussian((0, 0, 5.0), 3.0, 0.8)
    camera = Camera(33, 33, np.array([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]]))
    render = create_renderer(concatenated(back, front)).render(camera, np.eye(4))
    weights = np.array([0.5, 0.5 * 0.8])
    alpha, mean = weights.sum(), np.average([2.0, 5.0], weights=weights)
    assert render.alpha[16, 16] == pytest.approx(alpha, abs=1e-5)
    assert render.depth[16, 16] == pytest.approx(mean, abs=1e-5)
    deviation = np.sqrt(np.average((np.array([2.0, 5.0]) - mean) ** 2, weights=weights))
    assert render.depth_std[16, 16] == pytest.approx(deviation, abs=1e-5)


def test_no_depth_where_splats_cover_less_than_half() -> None:
    render = create_renderer(one_gaussian((0, 0, 2.0), 1.0, 0.4)).render(small_camera(), np.eye(4))
    assert render.alpha.max() > 0.3
    assert np.isnan(render.depth).all()
    assert np.isnan(render.depth_std).all()


def test_an_empty_view_shows_the_background() -> None:
    render = create_renderer(one_gaussian((0, 0, -2.0), 0.1, 1.0), background=(1.0, 0.5, 0.0)).render(
        small_camera(), np.eye(4)
    )
    assert not render.alpha.any()
    assert np.isnan(render.depth).all()
    np.testing.assert_array_equal(render.rgb, np.broadcast_to(np.float32([1.0, 0.5, 0.0]), render.rgb.shape))


@pytest.mark.parametrize(
    "harmless",
    [
        one_gaussian((0, 0, 0), 0.1, 1.0),  # at the camera
        one_gaussian((0, 0, 1e-9), 0.1, 1.0),  # at the camera plane
        one_gaussian((0.1, 0, -1), 0.1, 1.0),  # behind
        one_gaussian((0, 0, 3), 0.1, 0.0),  # nothing to see
        one_gaussian((0, 0, 3), 1e-20, 0.001),  # thinner than float32 and transparent
    ],
    ids=["at the camera", "at the camera plane", "behind", "zero opacity", "transparent point"],
)
def test_gaussians_that_cannot_be_seen_change_nothing(harmless: GaussianMap) -> None:
    visible = one_gaussian((0.2, 0.1, 2.0), 0.2, 0.9)
    camera = small_camera()
    alone = create_renderer(visible).render(camera, np.eye(4))
    together = create_renderer(concatenated(harmless, visible)).render(camera, np.eye(4))
    for field in ("rgb", "alpha", "depth", "depth_std"):
        np.testing.assert_array_equal(getattr(together, field), getattr(alone, field))


@pytest.mark.parametrize(
    "scales", [(1e3, 1e3, 1e3), (1e-7, 1e-7, 5.0), (5.0, 5.0, 1e-9)], ids=["huge", "needle", "disc"]
)
def test_extreme_shapes_are_drawn_as_the_reference_draws_them(scales) -> None:
    extreme = replace(one_gaussian((0.1, 0.2, 3.0), 1.0, 0.9), scales=np.array([scales], dtype=np.float32))
    gaussian_map = concatenated(extreme, one_gaussian((0.2, 0.1, 2.0), 0.2, 0.9))
    camera = small_camera()
    fast = create_renderer(gaussian_map).render(camera, np.eye(4))
    assert_same(fast, ReferenceRenderer(gaussian_map).render(camera, np.eye(4)), 60)


def test_maps_far_from_their_origin_render_alike() -> None:
    near = random_map(300, 0, seed=5)
    # What float32 can represent so far away, so that only the renderer's own arithmetic is tested.
    offset = np.float32(2**16)
    means = np.round(near.means * 64) / 64
    camera = small_camera()
    at_origin = create_renderer(replace(near, means=means)).render(camera, np.eye(4))
    pose = make_pose(np.eye(3), np.array([offset, 0, 0], dtype=np.float64))
    far_away = create_renderer(replace(near, means=means + np.float32([offset, 0, 0]))).render(camera, pose)
    assert psnr(at_origin, far_away) > 80


def test_crowded_tiles_make_the_buffers_grow() -> None:
    """Every Gaussian covers every tile: far more pairs than the buffers start with."""
    rng = np.random.default_rng(0)
    layers = [one_gaussian((0, 0, z), 20.0, 0.02, rng.uniform(size=3)) for z in np.linspace(2, 6, 700)]
    gaussian_map = concatenated(*layers)
    camera = Camera(320, 240, np.array([[100.0, 0, 160], [0, 100.0, 120], [0, 0, 1]]))
    fast = create_renderer(gaussian_map, threads=1).render(camera, np.eye(4))
    assert_same(fast, ReferenceRenderer(gaussian_map).render(camera, np.eye(4)), 60)


def test_threads_may_render_at_once() -> None:
    gaussian_map = random_map(500, 1, seed=1)
    renderer, camera = create_renderer(gaussian_map), small_camera()
    expected = renderer.render(camera, np.eye(4))
    results: list[Render] = []
    workers = [
        threading.Thread(target=lambda: results.extend(renderer.render(camera, np.eye(4)) for _ in range(5)))
        for _ in range(4)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(timeout=60)
    assert len(results) == 20
    for result in results:
        np.testing.assert_array_equal(result.rgb, expected.rgb)


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_antialiased_maps_agree_with_the_reference(sh_degree: int) -> None:
    gaussian_map = replace(random_map(800, sh_degree, seed=sh_degree), antialiased=True)
    camera = small_camera()
    fast = create_renderer(gaussian_map).render(camera, np.eye(4))
    assert_same(fast, ReferenceRenderer(gaussian_map).render(camera, np.eye(4)), 70)
    assert psnr(fast, create_renderer(replace(gaussian_map, antialiased=False)).render(camera, np.eye(4))) < 40


@pytest.mark.parametrize("render", [create_renderer, ReferenceRenderer])
@pytest.mark.parametrize("sigma", [0.1, 0.5, 2.0])
def test_the_blur_of_an_antialiased_gaussian_keeps_its_light(render, sigma: float) -> None:
    """A Gaussian of `sigma` pixels covers as much of the image as without the blur, however small it is."""
    camera = Camera(65, 65, np.array([[100.0, 0, 32], [0, 100.0, 32], [0, 0, 1]]))
    gaussian_map = replace(one_gaussian((0, 0, 10.0), sigma * 10.0 / 100.0, 0.99), antialiased=True)
    alpha = render(gaussian_map).render(camera, np.eye(4)).alpha
    assert alpha[32, 32] == pytest.approx(0.99 * sigma**2 / (sigma**2 + 0.3), rel=1e-3)
    # Tails under 1/255 are cut.
    assert alpha.sum() == pytest.approx(0.99 * 2 * np.pi * sigma**2, rel=0.15)


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(ValueError, match=r"tpu.*not one of"):
        create_renderer(one_gaussian((0, 0, 2), 0.1, 1.0), device="tpu")
