"""Maps that people brought, made after public reports."""

from __future__ import annotations

import numpy as np
import pytest

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import make_pose
from gsfeatloc_ros.maps import GaussianMap, MapError, ReadOptions, load_map
from gsfeatloc_ros.render import create_renderer


def drawn(gaussian_map: GaussianMap) -> np.ndarray:
    """Return a picture of the map from before it, along its z axis."""
    low, high = np.percentile(gaussian_map.means, [2, 98], axis=0).astype(np.float64)
    place = 0.5 * (low + high) - [0.0, 0.0, 1.5 * (high - low).max()]
    camera = Camera(160, 120, np.array([[160.0, 0.0, 79.5], [0.0, 160.0, 59.5], [0.0, 0.0, 1.0]]))
    return create_renderer(gaussian_map, "cpu").render(camera, make_pose(np.eye(3), place)).rgb


def test_a_map_with_a_3d_filter_is_drawn_as_fused(cases):
    fused = drawn(load_map(cases / "filter_3d_fused.ply"))
    assert fused.std() > 0.01
    np.testing.assert_allclose(drawn(load_map(cases / "filter_3d.ply")), fused, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "count", "left_out", "degree"),
    [
        ("opacity_inf.ply", 3000, 0, 0),
        ("opacity_minus_inf.ply", 3000, 0, 0),
        ("scale_minus_inf.ply", 3000, 0, 0),
        ("nan_positions.ply", 2997, 3, 0),
        ("zero_quaternion.ply", 2997, 3, 0),
        ("trailing_newline.ply", 3000, 0, 0),
        ("sh_degree4.ply", 3000, 0, 3),
        ("rgb_mode.ply", 3000, 0, 0),
        ("minimal-raw.spz", 4, 0, 0),
        ("sog_in_folder.sog", 31000, 0, 2),
        ("inria_output", 3000, 0, 0),
    ],
)
def test_a_map_is_read(cases, name, count, left_out, degree):
    gaussian_map = load_map(cases / name)
    assert (len(gaussian_map), gaussian_map.reading.left_out, gaussian_map.sh_degree) == (count, left_out, degree)
    assert np.isfinite(drawn(gaussian_map)).all()


def test_infinite_logits_are_opaque_and_not_there(cases):
    assert (load_map(cases / "opacity_inf.ply").opacities == 1.0).sum() == 50
    assert (load_map(cases / "opacity_minus_inf.ply").opacities == 0.0).sum() == 5


def test_an_spz_with_the_axes_of_its_ply_is_in_the_plys_frame(cases, maps):
    path, ply = cases / "splat-transform-3.7_ply_axes.spz", load_map(maps / "plush_dog.ply")
    told = load_map(path, options=ReadOptions(spz_axes="ply"))
    assert len(told) == len(ply)
    for quantile in (0.01, 0.5, 0.99):
        expected = np.quantile(ply.means, quantile, axis=0)
        np.testing.assert_allclose(np.quantile(told.means, quantile, axis=0), expected, atol=2e-3)
    assumed = load_map(path)
    assert "RUB" in "".join(assumed.reading.notes)
    assert "map.spz_axes:=ply" in assumed.reading.other


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("lod", "meta.json is missing"),  # only its lod-meta.json is there
        ("scene.ksplat", "ksplat.*splat-transform"),
        ("ckpt_29999_rank0.pt", "checkpoint of PyTorch"),
        ("cloudcompare.ply", "CloudCompare"),
        ("sparse_pc.ply", "point cloud"),
        ("lfs.ply", "git lfs pull"),
        ("plain.ply.gz", r"a \.ply in it: unpack"),
        ("map.zip", r"map\.ply in it: unpack"),
    ],
)
def test_a_file_of_others_is_named(cases, name, match):
    with pytest.raises(MapError, match=match) as error:
        load_map(cases / name)
    assert "damaged" not in str(error.value)
