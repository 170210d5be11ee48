"""A whole query on a GPU: the same answers as on the CPU, and no picture leaves the device before the pose is verified.

The GPU is a simulated one (stand_in/gpu.py).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import takewhile

import numpy as np
import pytest
import torch
from hazes import hazy
from kornia.feature import LightGlue
from stand_in.gpu import NAME, SimulatedGpu, simulated_gpu

from gsfeatloc_ros.common.geometry import rotation_error_deg, translation_error
from gsfeatloc_ros.localize.estimate import Status
from gsfeatloc_ros.localize.localizer import Localizer
from gsfeatloc_ros.match import MATCHERS, create_matcher
from gsfeatloc_ros.render import Render
from gsfeatloc_ros.render.cpu import CpuRenderer

# Bytes of matches, corners and what is at their pixels. The smallest picture, 320x240 in grey, has 76 800.
SMALL = 50_000


class OnGpu:
    """A renderer whose pictures lie on the simulated GPU."""

    device = NAME

    def __init__(self, gaussian_map) -> None:
        self._renderer = CpuRenderer(gaussian_map)
        self.solid_points, self.reading = self._renderer.solid_points, self._renderer.reading

    def render(self, camera, T_map_camera) -> Render:
        pictures = vars(self._renderer.render(camera, T_map_camera)).values()
        return Render(*(torch.from_numpy(picture).to(self.device) for picture in pictures))


@pytest.fixture
def gpu(monkeypatch) -> SimulatedGpu:
    # kornia knows from how many keypoints on it is worth dropping some, for the devices that it knows.
    monkeypatch.setitem(LightGlue.pruning_keypoint_thresholds, NAME, -1)
    with simulated_gpu() as gpu:
        yield gpu


@pytest.fixture(scope="module")
def renderer(room_map) -> OnGpu:
    return OnGpu(room_map)


@pytest.mark.parametrize("name", ["sift", "xfeat", "xfeat-lighterglue"])
def test_finds_the_camera_as_on_the_cpu(gpu, renderer, room_map, room_camera, room_photos, name) -> None:
    on_gpu = Localizer(renderer, MATCHERS[name].create("", 2048, gpu.device))
    on_cpu = Localizer(CpuRenderer(room_map), create_matcher(name, device="cpu"))
    for photo in room_photos[:1]:
        trace, here = (
            on_gpu.trace(photo.image, room_camera, photo.T_map_camera_prior),
            on_cpu.localize(photo.image, room_camera, photo.T_map_camera_prior),
        )
        there = trace.estimate
        assert there.status is here.status is Status.LOCALIZED
        assert rotation_error_deg(there.T_map_camera, here.T_map_camera) < 0.1
        assert translation_error(there.T_map_camera, here.T_map_camera) < 0.005
        assert there.evidence.inliers == pytest.approx(here.evidence.inliers, rel=0.1)
        assert trace.render is not None
        np.testing.assert_array_equal(trace.render.image().shape, photo.image.shape)


def test_sees_through_haze_as_on_the_cpu(gpu, room_map, room_camera, room_photos) -> None:
    photo = room_photos[0]
    haze = hazy(room_map, room_camera.pinhole(), photo.T_map_camera)
    on_gpu = Localizer(OnGpu(haze), MATCHERS["sift"].create("", 2048, gpu.device))
    on_cpu = Localizer(CpuRenderer(haze), create_matcher("sift", device="cpu"))
    there, here = (each.localize(photo.image, room_camera, photo.T_map_camera_prior) for each in (on_gpu, on_cpu))
    assert there.status is here.status is Status.LOCALIZED
    assert rotation_error_deg(there.T_map_camera, here.T_map_camera) < 0.1
    assert translation_error(there.T_map_camera, here.T_map_camera) < 0.01


@pytest.mark.parametrize("name", ["sift", "xfeat", "aliked-lightglue", "disk-lightglue"])
def test_no_picture_leaves_the_gpu_before_there_is_an_estimate(gpu, renderer, room_camera, room_photos, name) -> None:
    localizer = Localizer(renderer, MATCHERS[name].create("", 2048, gpu.device))
    photo = room_photos[0]
    image = photo.image.copy()
    image.flags.writeable = False  # as those of messages
    gpu.reset()
    estimate = localizer.localize(image, room_camera, photo.T_map_camera_prior)
    assert estimate.status is Status.LOCALIZED
    # On the host, the first render at an estimate shows whether the photo is blurred; verification compares pictures.
    assert max(gpu.to_host) > SMALL, gpu.explain()
    before = list(takewhile(lambda size: size <= SMALL, gpu.to_host))
    # The photo's corners; the depths that tell how far off a prior may be; of the render at the prior and the first at
    # an estimate, whether depths can be trusted, matches and the depths under them.
    assert sum(size > 100 for size in before) == 1 + 1 + 2 * 3, gpu.explain()


def test_a_matcher_on_the_cpu_takes_renders_of_a_gpu(gpu, renderer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    estimate = Localizer(renderer, create_matcher("sift", device="cpu")).localize(
        photo.image, room_camera, photo.T_map_camera_prior
    )
    assert estimate.status is Status.LOCALIZED
    assert translation_error(estimate.T_map_camera, photo.T_map_camera) < 0.02


def test_a_dark_photo_has_no_answer(gpu, renderer, room_camera, room_photos) -> None:
    photo = room_photos[0]
    estimate = Localizer(renderer, MATCHERS["sift"].create("", 2048, gpu.device)).localize(
        np.zeros_like(photo.image), room_camera, photo.T_map_camera_prior
    )
    assert estimate.status is Status.FAILED
    assert "0 corners in 0% of the photo" in estimate.reason


def test_a_render_of_nothing_has_no_answer(gpu, room_map, room_camera, room_photos) -> None:
    photo = room_photos[0]
    nothing = OnGpu(replace(room_map, means=room_map.means + np.float32([0, 0, 1e4])))
    estimate = Localizer(nothing, MATCHERS["sift"].create("", 2048, gpu.device)).localize(
        photo.image, room_camera, photo.T_map_camera_prior
    )
    assert estimate.status is Status.FAILED
