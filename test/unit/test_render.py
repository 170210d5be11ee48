"""The CPU renderer against the slow reference, and both against closed forms."""

from __future__ import annotations

import threading
import tracemalloc
from dataclasses import replace
from functools import partial

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import assert_same, concatenated, one_gaussian, psnr, random_map, small_camera

from gsfeatloc_ros import render as renderers
from gsfeatloc_ros.common import lanes as simd
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose, so3_exp, transform
from gsfeatloc_ros.maps import GaussianMap, load_map
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS
from gsfeatloc_ros.maps.ply import write_ply
from gsfeatloc_ros.render import DrawOptions, Render
from gsfeatloc_ros.render.base import DEPTH_MIN_ALPHA, MIN_ALPHA
from gsfeatloc_ros.render.enlarge import enlarge
from gsfeatloc_ros.render.prepare import CHUNK, prepare
from gsfeatloc_ros.render.reference import ReferenceRenderer

# Also on a machine with a GPU.
create_renderer = partial(renderers.create_renderer, device="cpu")

SH_C0 = 0.28209479177387814


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_agrees_with_the_reference_at_every_sh_degree(sh_degree: int) -> None:
    gaussian_map = random_map(800, sh_degree, seed=sh_degree)
    pose = make_pose(so3_exp(np.array([0.2, -0.3, 0.1])), np.array([0.3, -0.2, 0.5]))
    camera = small_camera()
    fast = create_renderer(gaussian_map, options=DrawOptions((0.2, 0.4, 0.6))).render(camera, pose)
    assert_same(fast, ReferenceRenderer(gaussian_map, (0.2, 0.4, 0.6)).render(camera, pose), 70)


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
    render = create_renderer(one_gaussian((0, 0, -2.0), 0.1, 1.0), options=DrawOptions((1.0, 0.5, 0.0))).render(
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


def needles(seed: int, count: int) -> GaussianMap:
    """Gaussians of up to thousands of pixels, many of them thinner than one, in all directions."""
    rng = np.random.default_rng(seed)
    gaussian_map = random_map(count, 0, seed)
    scales = np.exp(rng.uniform([-2, -12, -12], [5, 0, 0], (count, 3)))
    means = rng.uniform([-3, -3, 0.02], [3, 3, 4], (count, 3))
    return replace(gaussian_map, means=means.astype(np.float32), scales=scales.astype(np.float32))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_needles_are_nearly_drawn_as_the_reference_draws_them(seed: int) -> None:
    gaussian_map, camera = needles(seed, 100), Camera(320, 240, np.array([[250.0, 0, 160], [0, 250, 120], [0, 0, 1]]))
    fast = create_renderer(gaussian_map).render(camera, np.eye(4))
    assert psnr(fast, ReferenceRenderer(gaussian_map).render(camera, np.eye(4))) > 40
    # Among many, some are so long and thin that float32 has nothing left of their width.
    crowd = create_renderer(needles(seed, 20_000)).render(camera, np.eye(4))
    assert ((crowd.rgb >= 0) & (crowd.rgb <= 1)).all()


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


def test_splats_are_drawn_in_order_however_close_they_are() -> None:
    """Pairs of red and green, apart by about as much as float32 can say: calculated in it, many fall the wrong way."""
    rng = np.random.default_rng(3)
    camera = Camera(320, 320, np.array([[300.0, 0, 159.5], [0, 300.0, 159.5], [0, 0, 1]]))
    pixels = np.stack(np.meshgrid(*[np.arange(8, 320, 16)] * 2), axis=-1).reshape(-1, 2)
    pose = make_pose(so3_exp(rng.normal(size=3)), rng.uniform(-5, 5, 3))
    red = transform(pose, camera.rays(pixels.astype(float)) * rng.uniform(3, 4, (len(pixels), 1))).astype(np.float32)
    green = red + rng.uniform(-5e-7, 5e-7, red.shape).astype(np.float32)
    ones = np.ones(2 * len(red), np.float32)
    colours = np.repeat([[1.0, 0, 0], [0, 1.0, 0]], len(red), axis=0)
    gaussian_map = GaussianMap(
        means=np.concatenate([red, green]),
        scales=0.01 * ones[:, None] * np.ones(3, np.float32),
        rotations=ones[:, None] * np.float32([1, 0, 0, 0]),
        opacities=0.8 * ones,
        sh=((colours - 0.5) / SH_C0).astype(np.float32)[:, None],
    )
    red_depth, green_depth = (
        ((points.astype(np.float64) - pose[:3, 3]) @ pose[:3, 2]).astype(np.float32) for points in (red, green)
    )
    drawn = create_renderer(gaussian_map).render(camera, pose).rgb[pixels[:, 1], pixels[:, 0]]
    told_apart = red_depth != green_depth
    assert told_apart.sum() > 100
    np.testing.assert_array_equal((drawn[:, 0] > drawn[:, 1])[told_apart], (red_depth < green_depth)[told_apart])


@pytest.mark.parametrize("opaque", [0.02, 0.5, 1.0])
def test_a_camera_inside_dense_matter_sees_what_the_reference_sees(opaque: float) -> None:
    """Half-transparent or opaque from all sides, and through the near plane: where and behind what rays end matters."""
    rng = np.random.default_rng(0)
    cloud = random_map(1500, 1, seed=2)
    means = rng.uniform(-0.5, 0.5, (len(cloud), 3)).astype(np.float32)
    dense = replace(cloud, means=means, opacities=np.full(len(cloud), opaque, np.float32))
    camera = small_camera()
    fast = create_renderer(dense).render(camera, np.eye(4))
    assert fast.alpha.min() > 0.5
    assert_same(fast, ReferenceRenderer(dense).render(camera, np.eye(4)), 70)


def test_what_lies_behind_a_wall_does_not_change_the_picture() -> None:
    """A wall of eight layers lets nothing through: with half of a map behind it the picture is the same to the bit."""
    layers = [one_gaussian((0, 0, 2 + 0.01 * k), 20.0, 0.9, (0.1 * k, 0.5, 0.3)) for k in range(8)]
    front, behind = concatenated(*layers), random_map(2000, 0, seed=4)
    behind = replace(behind, means=behind.means + np.float32([0, 0, 30]))
    alone, together = (
        create_renderer(m).render(small_camera(), np.eye(4)) for m in (front, concatenated(front, behind))
    )
    for field in ("rgb", "alpha", "depth", "median_depth", "depth_std"):
        np.testing.assert_array_equal(getattr(together, field), getattr(alone, field))


@pytest.mark.slow
def test_crowded_tiles_make_the_buffers_grow() -> None:
    """Every Gaussian covers every tile: far more pairs than the buffers start with."""
    rng = np.random.default_rng(0)
    layers = [one_gaussian((0, 0, z), 20.0, 0.02, rng.uniform(size=3)) for z in np.linspace(2, 6, 700)]
    gaussian_map = concatenated(*layers)
    camera = Camera(320, 240, np.array([[100.0, 0, 160], [0, 100.0, 120], [0, 0, 1]]))
    fast = create_renderer(gaussian_map, threads=1).render(camera, np.eye(4))
    assert_same(fast, ReferenceRenderer(gaussian_map).render(camera, np.eye(4)), 60)


def test_threads_may_prepare_and_render_at_once() -> None:
    gaussian_map = random_map(20_000, 1, seed=1)
    renderer, camera = create_renderer(gaussian_map), small_camera()
    expected = renderer.render(camera, np.eye(4))
    results: list[Render] = []

    def prepare_and_render() -> None:
        for _ in range(5):
            prepare(gaussian_map)
            results.append(renderer.render(camera, np.eye(4)))

    workers = [threading.Thread(target=prepare_and_render) for _ in range(4)]
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


seeds = st.integers(0, 2**32 - 1)


def nasty_gaussians(rng: np.random.Generator, count: int) -> GaussianMap:
    """Gaussians round the camera at the origin: at its centre and plane, behind it, huge, needles, discs, invisible."""
    kinds = rng.integers(0, 7, count)
    means = rng.uniform([-2, -2, 0.5], [2, 2, 6], (count, 3))
    scales = np.exp(rng.uniform(-5, -1, (count, 3)))
    opacities = rng.uniform(0, 1, count)
    means[kinds == 0] *= 1e-6
    means[kinds == 1, 2] = rng.uniform(-0.02, 0.02, np.count_nonzero(kinds == 1))
    means[kinds == 2, 2] *= -1
    scales[kinds == 3] *= 1e4
    scales[kinds == 4] *= [1e-6, 1e-6, 10]
    scales[kinds == 5] *= [10, 10, 1e-6]
    opacities[kinds == 6] = rng.choice([0.0, 1e-9, MIN_ALPHA])
    rotations = rng.normal(size=(count, 4))
    return GaussianMap(
        means=means.astype(np.float32),
        scales=scales.astype(np.float32),
        rotations=(rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        opacities=opacities.astype(np.float32),
        sh=rng.normal(scale=0.5, size=(count, 4, 3)).astype(np.float32),
    )


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(seed=seeds, count=st.integers(1, 40), antialiased=st.booleans())
def test_nasty_gaussians_do_no_harm(seed: int, count: int, antialiased: bool) -> None:
    rng = np.random.default_rng(seed)
    gaussian_map = replace(nasty_gaussians(rng, count), antialiased=antialiased)
    camera = small_camera()
    pose = make_pose(so3_exp(rng.normal(0, 0.2, 3)), rng.normal(0, 0.1, 3))
    fast = create_renderer(gaussian_map).render(camera, pose)
    for image in (fast.rgb, fast.alpha):
        assert ((image >= 0) & (image <= 1)).all()  # which NaN is not
    for image in (fast.depth, fast.median_depth, fast.depth_std):
        np.testing.assert_array_equal(np.isfinite(image), fast.alpha >= DEPTH_MIN_ALPHA)
    assert psnr(fast, ReferenceRenderer(gaussian_map).render(camera, pose)) >= 50


@settings(max_examples=15, deadline=None)
@given(seed=seeds, shift_x=st.integers(1, 9), shift_y=st.integers(1, 9))
def test_there_is_no_seam_at_tile_borders(seed: int, shift_x: int, shift_y: int) -> None:
    """Pixels do not depend on where in a tile they are."""
    camera = small_camera(80, 64)
    rng = np.random.default_rng(seed)
    # Centres in both pictures or just outside: further out it depends on the view where a Gaussian is linearised.
    means = camera.rays(rng.uniform([0, 0], [79, 63], (300, 2))) * rng.uniform(1, 6, (300, 1))
    renderer = create_renderer(replace(random_map(300, 1, seed), means=means.astype(np.float32)))
    moved = camera.K.copy()
    moved[:2, 2] += shift_x, shift_y
    whole, part = (renderer.render(c, np.eye(4)).rgb for c in (camera, Camera(80, 64, moved)))
    difference = np.abs(part[shift_y:, shift_x:] - whole[: 64 - shift_y, : 80 - shift_x])
    # Where alpha is at the limit of 1/255, rounding decides whether it counts: at a few pixels, not along a border.
    assert np.quantile(difference, 0.99) < 1e-4
    assert difference.max() < 0.02


@pytest.mark.parametrize("threads", [2, 3, 1024])
def test_threads_do_not_change_the_picture(threads: int) -> None:
    gaussian_map = random_map(3000, 1, seed=3)
    camera = small_camera(200, 100)
    one, many = (create_renderer(gaussian_map, threads=n).render(camera, np.eye(4)) for n in (1, threads))
    for field in ("rgb", "alpha", "depth", "median_depth", "depth_std"):
        np.testing.assert_array_equal(getattr(many, field), getattr(one, field))


def wall(seed: int) -> GaussianMap:
    """Ten thousand Gaussians, mostly small and a few long, in a box round the origin: some forty chunks."""
    rng = np.random.default_rng(seed)
    count = 10_000
    sizes = np.exp(rng.normal(-4, 1, (count, 3)))
    gaussian_map = random_map(count, 0, seed)
    means = rng.uniform(-1, 1, (count, 3))
    # About the faces of a cube: at the very same depth, the order of drawing is nobody's business.
    means[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-1, 1], count) + rng.normal(0, 1e-3, count)
    return replace(gaussian_map, means=means.astype(np.float32), scales=sizes.astype(np.float32))


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(seed=seeds, focal=st.floats(5, 500), along_an_axis=st.booleans())
def test_culling_drops_nothing_that_is_seen(seed: int, focal: float, along_an_axis: bool) -> None:
    """Cameras in and near a map, some looking along the borders of its chunks, see what they see of all chunks."""
    rng = np.random.default_rng(seed)
    prepared = prepare(wall(seed % 3))
    assert len(prepared.gaussians) > 30
    everywhere = np.full_like(prepared.low, np.inf)
    unculled = replace(prepared, low=-everywhere, high=everywhere)
    if along_an_axis:
        rotation = so3_exp(rng.integers(-2, 3, 3) * np.pi / 2)
        center = rng.integers(-2, 3, 3) / 2
    else:
        rotation, center = so3_exp(rng.normal(0, 2, 3)), rng.uniform(-1.5, 1.5, 3)
    camera = Camera(48, 32, np.array([[focal, 0, rng.uniform(-10, 60)], [0, focal, 15.5], [0, 0, 1]]))
    pose = make_pose(rotation, center)
    culled, whole = (create_renderer(m).render(camera, pose) for m in (prepared, unculled))
    np.testing.assert_array_equal(culled.rgb, whole.rgb)
    np.testing.assert_array_equal(culled.depth, whole.depth)


def test_culled_views_agree_with_the_reference() -> None:
    gaussian_map = wall(0)
    for pose in (np.eye(4), make_pose(so3_exp(np.array([0, np.pi / 2, 0])), np.array([0.5, 0, 0]))):
        fast = create_renderer(gaussian_map).render(small_camera(), pose)
        assert_same(fast, ReferenceRenderer(gaussian_map).render(small_camera(), pose), 70)


def test_a_map_without_a_visible_gaussian_shows_the_background() -> None:
    render = create_renderer(one_gaussian((0, 0, 2), 0.1, 0.0), options=DrawOptions((0.2, 0.4, 0.6))).render(
        small_camera(), np.eye(4)
    )
    assert not render.alpha.any()
    np.testing.assert_array_equal(render.rgb[0, 0], np.float32([0.2, 0.4, 0.6]))


@settings(max_examples=20, deadline=None)
@given(seed=seeds, count=st.integers(0, 1000), sh_degree=st.integers(0, 3))
def test_prepared_maps_hold_what_can_be_seen_within_their_boxes(seed: int, count: int, sh_degree: int) -> None:
    gaussian_map = random_map(count, sh_degree, seed)
    prepared = prepare(gaussian_map)
    seen = gaussian_map.opacities >= MIN_ALPHA
    assert prepared.gaussians.shape == (-(-np.count_nonzero(seen) // CHUNK), 10, CHUNK)
    rows = prepared.gaussians.transpose(1, 0, 2)
    drawn = np.isfinite(rows[9])  # the others fill up the last chunk
    means = rows[:3, drawn].T
    # Each Gaussian that can be seen is there once, with its own colours.
    order, expected = np.lexsort(means.T), np.lexsort(gaussian_map.means[seen].T)
    np.testing.assert_array_equal(means[order], gaussian_map.means[seen][expected])
    sh = prepared.sh.transpose(0, 2, 1)[drawn].reshape(-1, *gaussian_map.sh.shape[1:])
    np.testing.assert_allclose(sh[order], gaussian_map.sh[seen][expected], rtol=2**-11, atol=2**-14)
    # The point of its ellipsoid furthest along an axis is where alpha is 1/255: it is in the chunk's box.
    reach = np.sqrt(2 * np.log(2 ** rows[9].clip(-8) / MIN_ALPHA).clip(0) * rows[[3, 6, 8]]).transpose(1, 2, 0)
    means = rows[:3].transpose(1, 2, 0)
    inside = (means - reach >= prepared.low[:, None]) & (means + reach <= prepared.high[:, None])
    assert inside[drawn].all()


def test_prepared_maps_take_little_memory() -> None:
    gaussian_map = random_map(100 * CHUNK, 3, seed=0)
    prepared = prepare(gaussian_map)
    parameters = 4 * (3 + 3 + 4 + 1 + 48) * len(gaussian_map)
    assert sum(a.nbytes for a in (prepared.gaussians, prepared.sh, prepared.low, prepared.high)) < 0.6 * parameters


def test_loading_takes_little_more_than_the_map_and_what_is_prepared_from_it(tmp_path) -> None:
    path = tmp_path / "map.ply"
    write_ply(path, random_map(400 * CHUNK, 3, seed=0))
    prepare(load_map(path))  # what compiled kernels take does not count
    tracemalloc.start()
    try:
        prepare(load_map(path))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    parameters = 4 * (3 + 3 + 4 + 1 + 48) * 400 * CHUNK
    assert 1.5 * parameters < peak <= 1.6 * parameters


def test_a_prepared_map_renders_as_the_map_itself() -> None:
    gaussian_map = random_map(3000, 3, seed=0)
    a, b = (create_renderer(m).render(small_camera(), np.eye(4)) for m in (gaussian_map, prepare(gaussian_map)))
    assert a.alpha.max() > 0.9
    np.testing.assert_array_equal(a.rgb, b.rgb)


def test_colours_too_bright_for_half_precision_stay_finite() -> None:
    glaring = one_gaussian((0, 0, 2.0), 0.5, 0.9, color=(1e6, 0.5, -1e6))
    render = create_renderer(glaring).render(small_camera(), np.eye(4))
    middle = render.rgb[render.alpha > 0.5]
    np.testing.assert_array_equal(middle[:, 0], 1.0)
    np.testing.assert_array_equal(middle[:, 2], 0.0)


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_spherical_harmonics_are_drawn_up_to_the_degree_asked_for(sh_degree: int) -> None:
    gaussian_map = random_map(500, 2, seed=7)
    capped = create_renderer(gaussian_map, options=DrawOptions(sh_degree=sh_degree)).render(small_camera(), np.eye(4))
    cut = replace(gaussian_map, sh=gaussian_map.sh[:, : SH_COEFFICIENTS[sh_degree]])
    np.testing.assert_array_equal(capped.rgb, create_renderer(cut).render(small_camera(), np.eye(4)).rgb)


def test_a_picture_drawn_small_is_about_the_same_and_says_where_depth_is_uncertain() -> None:
    """A near disc before a far wall: at its edge the enlarged depth is neither's."""
    disc, backdrop = one_gaussian((0, 0, 2.0), 0.3, 1.0), one_gaussian((0, 0, 4.0), 30.0, 1.0)
    gaussian_map = concatenated(replace(disc, scales=np.float32([[0.3, 0.3, 1e-3]])), backdrop)
    camera = Camera(160, 120, np.array([[100.0, 0, 79.5], [0, 100.0, 59.5], [0, 0, 1]]))
    whole = create_renderer(gaussian_map).render(camera, np.eye(4))
    small = create_renderer(gaussian_map, options=DrawOptions(resolution_scale=0.5)).render(camera, np.eye(4))
    assert psnr(whole, small) > 40
    for field in ("rgb", "alpha", "depth", "median_depth", "depth_std"):
        assert getattr(small, field).shape == getattr(whole, field).shape
        assert getattr(small, field).dtype == np.float32
    assert np.isfinite(small.depth).all()
    certain = small.depth_std < 0.01
    assert certain.mean() > 0.3
    np.testing.assert_allclose(small.depth[certain], whole.depth[certain], rtol=1e-3)
    np.testing.assert_allclose(small.depth, whole.depth, atol=0.25)


@settings(max_examples=60, deadline=None)
@given(
    seed=seeds, width=st.integers(1, 30), height=st.integers(1, 20), scale=st.floats(0.1, 1), holes=st.floats(0, 0.5)
)
def test_tensors_are_enlarged_as_arrays_are(seed, width: int, height: int, scale: float, holes: float) -> None:
    rng = np.random.default_rng(seed)
    rgb, alpha = rng.random((height, width, 3), np.float32), rng.random((height, width), np.float32)
    # Depths rise, so that where the nearest pixel is a matter of rounding it makes little difference.
    depth = (2 + np.arange(width) / width + np.arange(height)[:, None] / height).astype(np.float32)
    depth_std = rng.uniform(0, 0.1, depth.shape).astype(np.float32)
    for picture in (depth, depth_std):
        picture[rng.random(depth.shape) < holes] = np.nan
    depth_std[np.isnan(depth)] = depth[np.isnan(depth_std)] = np.nan
    arrays = Render(rgb, depth, depth, depth_std, alpha)
    tensors = Render(*(torch.from_numpy(picture) for picture in (rgb, depth, depth, depth_std, alpha)))
    size = round(width / scale), round(height / scale)
    wanted, found = enlarge(arrays, *size), enlarge(tensors, *size)
    for name in ("rgb", "depth", "median_depth", "depth_std", "alpha"):
        a, b = getattr(wanted, name), getattr(found, name)
        assert isinstance(b, torch.Tensor)
        assert (b.dtype, tuple(b.shape)) == (torch.float32, a.shape)
        assert b.is_contiguous()
        # A neighbour that has no weight and no depth counts here and not there.
        both = np.isfinite(a) & np.isfinite(b.numpy())
        tolerance = {"median_depth": 1.01 * (1 / width + 1 / height), "depth_std": 2e-3}.get(name, 5e-5)
        np.testing.assert_allclose(b.numpy()[both], a[both], rtol=0, atol=tolerance)
    # Where all have a depth, so has the picture.
    if not np.isnan(depth).any():
        assert np.isfinite(found.depth.numpy()).all()


@pytest.mark.parametrize("threads", [-1, 100_000])
def test_a_number_of_threads_out_of_range_is_refused(threads: int) -> None:
    with pytest.raises(ValueError, match=r"threads is .*must be from"):
        create_renderer(one_gaussian((0, 0, 2), 0.1, 1.0), threads=threads)


@pytest.mark.parametrize(
    "options",
    [
        {"sh_degree": -1},
        {"sh_degree": 4},
        {"resolution_scale": 0.0},
        {"resolution_scale": 1.5},
        {"resolution_scale": float("nan")},
    ],
)
def test_options_out_of_range_are_refused(options) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(options))} is .*must be from"):
        DrawOptions(**options)


@numba.njit
def _exp2_and_columns(values, powers, columns):
    rows = simd.load(values, 0)
    simd.store(powers, 0, simd.exp2(rows))
    zero = simd.broadcast(np.float32(0))
    matrix = (rows, zero, rows * 2, rows, rows, rows, rows, rows, rows, rows, rows, rows, rows, rows, rows, rows - 1)
    return simd.store_columns(columns, 0, rows > 0, matrix), simd.total(rows)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-126, 127, width=32), min_size=simd.LANES, max_size=simd.LANES))
def test_lanes_calculate_as_numbers_do(numbers: list[float]) -> None:
    values = np.array(numbers, dtype=np.float32)
    powers, columns = np.empty(simd.LANES, np.float32), np.empty(simd.LANES**2, np.float32)
    end, total = _exp2_and_columns(values, powers, columns)
    assert total == pytest.approx(values.sum(dtype=np.float64), rel=1e-5, abs=1e-3)
    np.testing.assert_allclose(powers, np.exp2(values.astype(np.float64)), rtol=5e-6)
    positive = values[values > 0]
    assert end == simd.LANES * len(positive)
    columns = columns[:end].reshape(-1, simd.LANES)
    np.testing.assert_array_equal(columns[:, 0], positive)
    np.testing.assert_array_equal(columns[:, 1], 0)
    np.testing.assert_array_equal(columns[:, 2], 2 * positive)
    np.testing.assert_array_equal(columns[:, -1], positive - 1)


def test_an_unknown_device_is_refused() -> None:
    with pytest.raises(ValueError, match=r"tpu.*not one of"):
        create_renderer(one_gaussian((0, 0, 2), 0.1, 1.0), device="tpu")
