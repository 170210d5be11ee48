"""The simulated GPU: its tensors keep apart from the CPU's, compute the CPU's numbers, and nothing goes unnoted."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from kornia.feature import LightGlue
from kornia.geometry.subpix import nms2d
from pictures import rectangles, shifted
from stand_in.gpu import SimulatedGpu, as_kernel, simulated_gpu
from torch.nn.attention import SDPBackend, sdpa_kernel

from gsfeatloc_ros.match.aliked import AlikedExtractor
from gsfeatloc_ros.match.base import Matcher
from gsfeatloc_ros.match.disk import DiskExtractor
from gsfeatloc_ros.match.lightglue import LightGlueMatcher
from gsfeatloc_ros.match.xfeat import XFeatMatcher
from gsfeatloc_ros.render.depth_bins import BINS, DepthBins

MIXED = "two devices"


@pytest.fixture(params=[torch.enable_grad, torch.no_grad, torch.inference_mode])
def gpu(request) -> SimulatedGpu:
    with simulated_gpu() as gpu, request.param():
        yield gpu


@pytest.fixture
def x(gpu) -> torch.Tensor:
    """Six numbers on the device, whose coming there is forgotten."""
    x = torch.arange(6.0).reshape(2, 3).to(gpu.device)
    gpu.reset()
    return x


def noted(gpu: SimulatedGpu, act: Callable[[], object]) -> tuple[list[str], list[int], list[int], list[str]]:
    gpu.reset()
    act()
    return gpu.operations, gpu.to_host, gpu.to_device, gpu.waits


# Where tensors are


@pytest.mark.parametrize(
    "make",
    [
        lambda device: torch.zeros(2, 3, device=device),
        lambda device: torch.full((3,), 7.0, device=device),
        lambda device: torch.eye(3, device=device),
        lambda device: torch.arange(3, 9, 2, device=device),
        lambda device: torch.linspace(0, 1, 5, device=device),
        lambda device: torch.tensor([[1, 2], [3, 4]], device=device),
        lambda device: torch.as_tensor(np.arange(3), device=device),
        lambda device: torch.tensor([], device=device),
        lambda device: torch.ones(3).new_ones(2, device=device),
        lambda device: torch.arange(3.0).to(device, torch.float64),
        lambda device: torch.zeros(3, device=device).new_zeros(2),
        lambda device: torch.zeros_like(torch.ones(2, 3, device=device)),
    ],
)
def test_tensors_are_made_on_the_device_and_brought_back(gpu, make) -> None:
    on_device, on_cpu = make(gpu.device), make("cpu")
    assert on_device.device == torch.device(gpu.device, 0)
    back = on_device.cpu()
    assert type(back) is torch.Tensor
    assert (back.dtype, back.stride()) == (on_cpu.dtype, on_cpu.stride())
    assert torch.equal(back, on_cpu)
    assert on_device.tolist() == on_cpu.tolist()


def test_other_tensors_stay_where_they_were(gpu, x) -> None:
    assert type(torch.zeros(3) + torch.arange(3)) is torch.Tensor
    assert type(torch.zeros_like(x, device="cpu")) is torch.Tensor
    assert (gpu.operations, gpu.to_host) == ([], [])


def test_modules_move_there_and_back(gpu) -> None:
    module = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.BatchNorm2d(4), torch.nn.ReLU()).eval()
    image = torch.rand(1, 3, 8, 9)
    wanted = module(image)
    module.to(gpu.device)
    assert torch.equal(module(image.to(gpu.device)).cpu(), wanted)
    with pytest.raises(RuntimeError, match=MIXED):
        module(image)
    assert torch.equal(copy.deepcopy(module).cpu()(image), wanted)


@pytest.mark.parametrize(
    "mix",
    [
        lambda x: x + torch.ones(3),
        lambda x: torch.ones(3) + x,
        lambda x: x[0, 0] + torch.ones(3),
        lambda x: x @ torch.ones(3),
        lambda x: torch.where(x > 1, x, torch.ones(3)),
        lambda x: torch.cat([x, torch.ones(2, 3)]),
        lambda x: torch.stack([x[0, 0], torch.tensor(1.0)]),
        lambda x: F.conv1d(x[None], torch.ones(1, 2, 1)),
        lambda x: x.clamp(min=torch.zeros(3)),
        lambda x: x.gather(1, torch.zeros(2, 1, dtype=torch.long)),
        lambda x: x.index_select(0, torch.tensor([0])),
        lambda x: x.masked_fill(torch.ones(2, 3, dtype=torch.bool), 0.0),
        lambda x: x.index_put((torch.tensor([0]),), torch.ones(3)),
        lambda x: torch.ones(9)[x[0].long()],
        lambda x: torch.ones(2, 3).mul_(x),
        lambda x: torch.tensor(1.0).add_(x[0, 0]),
        lambda x: torch.add(x, 1, out=torch.empty(2, 3)),
        lambda x: torch.bucketize(x, torch.arange(3.0)),
        lambda x: F.grid_sample(x[None, None], torch.zeros(1, 1, 1, 2), align_corners=True),
    ],
)
def test_what_mixes_devices_is_refused(gpu, x, mix) -> None:
    mix(x.cpu())
    with pytest.raises(RuntimeError, match=MIXED):
        mix(x)


def test_single_numbers_of_the_cpu_may_be_mixed_in(gpu, x) -> None:
    mixed = torch.where(x > torch.tensor(3.0), torch.tensor(-1.0), x * torch.tensor(2.0))
    assert mixed.tolist() == [[0, 2, 4], [6, -1, -1]]
    assert (gpu.to_device, gpu.waits) == ([], ["_to_copy"])


def test_indices_of_the_cpu_are_copied_to_the_device(gpu, x) -> None:
    index = torch.tensor([1, 0])
    assert noted(gpu, lambda: x[index]) == (["index"], [], [16], ["index"])
    assert x[index].tolist() == [[3, 4, 5], [0, 1, 2]]
    x[torch.tensor([True, False])] = torch.zeros(3, device=gpu.device)
    assert x.tolist() == [[0, 0, 0], [3, 4, 5]]


def test_numpy_is_refused(gpu, x) -> None:
    for read in (lambda: x.numpy(), lambda: np.asarray(x), lambda: np.array([x[0], x[1]])):
        with pytest.raises(TypeError, match=r"Tensor\.cpu\(\)"):
            read()
    np.testing.assert_array_equal(x.cpu().numpy(), [[0, 1, 2], [3, 4, 5]])


def test_views_share_their_numbers(gpu, x) -> None:
    x[:, 1:].T[0].mul_(10)
    x.unsqueeze_(0)
    assert x.shape == (1, 2, 3)
    assert x.tolist() == [[[0, 10, 2], [3, 40, 5]]]


def test_other_threads_see_the_device(gpu) -> None:
    found = []
    thread = threading.Thread(target=lambda: found.append(torch.tensor([1.0, 2], device=gpu.device) + 1))
    thread.start()
    thread.join()
    assert found[0].tolist() == [2, 3]


def test_there_is_none_outside() -> None:
    with simulated_gpu() as gpu:
        x = torch.zeros(3, device=gpu.device)
    with pytest.raises(RuntimeError, match="outside"):
        x + 1


# What is noted


@pytest.mark.parametrize(
    ("act", "operations"),
    [
        (lambda x: (x[:, 1:], x.T, x[None], x.reshape(3, 2), x.detach(), x.unbind(), x.expand(4, 2, 3)), []),
        (lambda x: (x.shape, len(x), x.dtype, x.is_contiguous(), torch.empty_like(x), x.to(x.device)), []),
        (lambda x: torch.zeros(3, device=x.device), ["zero_"]),
        (lambda x: x * 2 + x, ["mul", "add"]),
        (lambda x: x.T.contiguous(), ["clone"]),
        (lambda x: x.double(), ["_to_copy"]),
        (lambda x: x.clone().copy_(x), ["clone", "copy_"]),
        (lambda x: F.max_pool2d(x[None], 2), ["max_pool2d_with_indices"]),
    ],
)
def test_operations(gpu, x, act, operations) -> None:
    assert noted(gpu, lambda: act(x)) == (operations, [], [], []), gpu.explain()


@pytest.mark.parametrize(
    ("copy_back", "size"),
    [
        (lambda x: x.cpu(), 24),
        (lambda x: x[0].to("cpu"), 12),
        (lambda x: x.tolist(), 24),
        (lambda x: torch.empty(2, 3).copy_(x), 24),
        (lambda x: x[0, 0].item(), 4),
        (lambda x: float(x[0, 0]), 4),
        (lambda x: bool(x[0, 0]), 4),
        (lambda x: f"{x[0, 0]:.1f}", 4),
    ],
)
def test_copies_to_the_host_wait(gpu, x, copy_back, size) -> None:
    operations, to_host, to_device, waits = noted(gpu, lambda: copy_back(x))
    assert (to_host, to_device, len(waits)) == ([size], [], 1), gpu.explain()
    assert "copy" not in "".join(operations)


@pytest.mark.parametrize(
    ("send", "size", "waits"),
    [
        (lambda x: torch.ones(3).to(x.device), 12, 1),
        (lambda x: torch.ones(3).to(x.device, non_blocking=True), 12, 0),
        (lambda x: torch.tensor([1.0, 2], device=x.device), 8, 1),
        (lambda x: x.copy_(torch.ones(2, 3)), 24, 1),
        (lambda x: x.copy_(torch.ones(2, 3), non_blocking=True), 24, 0),
        (lambda x: x[0].copy_(torch.ones(3), True), 12, 0),
    ],
)
def test_copies_to_the_device_wait_if_told_to(gpu, x, send, size, waits) -> None:
    operations, to_host, to_device, waited = noted(gpu, lambda: send(x))
    assert (operations, to_host, to_device, len(waited)) == ([], [], [size], waits), gpu.explain()


@pytest.mark.parametrize(
    ("act", "waits"),
    [
        (lambda x: x.nonzero(), ["nonzero"]),
        (lambda x: torch.where(x > 2), ["nonzero"]),
        (lambda x: x[x > 2], ["index"]),
        (lambda x: x.masked_select(x > 2), ["masked_select"]),
        (lambda x: x.unique(), ["_unique2"]),
        (lambda x: torch.equal(x, x), ["equal"]),
        (lambda x: x[0].repeat_interleave(x[0].long()), ["repeat_interleave"]),
        (lambda x: torch.linalg.inv(x[:, :2]), ["_linalg_check_errors"]),
        (lambda x: x.index_put_((x > 2,), torch.zeros(1, device=x.device)), ["index_put_"]),
        (lambda x: x.index_put_((x > 2,), torch.tensor(0.0)), []),
        (lambda x: x.index_put_((x[:, 0] > 2, x[0, :1].long()), torch.tensor(0.0)), ["index_put_"]),
        (lambda x: x.masked_fill_(x > 2, 0.0), []),
        (lambda x: torch.where(x > 2, x, 0.0), []),
        (lambda x: x[:, x[0].long()], []),
        (lambda x: x.sort().values.topk(2), []),
    ],
)
def test_what_needs_a_number_from_the_device_waits(gpu, x, act, waits) -> None:
    assert noted(gpu, lambda: act(x))[1:] == ([], [], waits), gpu.explain()


def test_kernels_of_others_take_the_devices_tensors(gpu, x) -> None:
    def statistics(values: torch.Tensor, scale: float) -> dict[str, torch.Tensor]:
        return {"sum": torch.from_numpy(scale * values.numpy().sum(1))}

    kernel = as_kernel(statistics)
    found = kernel(x, scale=2.0)["sum"]
    assert (gpu.operations, found.device.type) == (["statistics"], gpu.device)
    assert found.tolist() == [6, 24]
    with pytest.raises(RuntimeError, match="statistics"):
        kernel(torch.ones(2, 3), scale=2.0)


def test_counts_start_anew(gpu, x) -> None:
    x.add(1).cpu()
    with simulated_gpu() as inner:
        x.sub(1)
    assert (inner.operations, gpu.operations, gpu.to_host) == (["sub"], ["add"], [24])
    gpu.reset()
    assert (gpu.operations, gpu.to_host, gpu.to_device, gpu.waits) == ([], [], [], [])


# Real things, whose numbers are the CPU's to the last bit

# The CPU has a kernel of its own for attention, which is taken apart for the device.
STEPS = SDPBackend.MATH

IMAGE = torch.from_numpy(rectangles(48, 64)).permute(2, 0, 1)[None].float() / 255
SQUARE = IMAGE[0, 0, :8, :8] + 4 * torch.eye(8)


@pytest.mark.parametrize(
    "compute",
    [
        lambda image, square: F.grid_sample(image, image[:, :2].permute(0, 2, 3, 1), align_corners=True),
        lambda image, square: F.conv2d(image, image[:, :, :3, :3].expand(4, 3, 3, 3), padding=1),
        lambda image, square: F.interpolate(image, scale_factor=0.5, mode="bilinear", antialias=True),
        lambda image, square: F.pad(image, (2, 1, 2, 1), mode="replicate"),
        lambda image, square: F.scaled_dot_product_attention(image, image, image),
        lambda image, square: F.unfold(image, 3),
        lambda image, square: torch.stack([image.flatten().topk(50).values, image.flatten().sort().values[:50]]),
        lambda image, square: image.cumsum(-1),
        lambda image, square: torch.zeros_like(image).scatter_add(3, (image * 60).long(), image),
        lambda image, square: torch.zeros_like(square).index_add_(0, torch.arange(8, device=square.device), square),
        lambda image, square: torch.bucketize(image.contiguous(), square[0].sort().values),
        lambda image, square: torch.searchsorted(square.sort().values, square),
        lambda image, square: torch.linalg.solve(square, square[0]),
        lambda image, square: torch.linalg.pinv(square[:5]),
        lambda image, square: torch.linalg.eigh(square @ square.T).eigenvalues,
        lambda image, square: torch.einsum("nchw,ndhw->cd", image, image),
        lambda image, square: image.quantile(0.3) + image.median() + image.std(),
        lambda image, square: nms2d(image, (5, 5)),
    ],
)
def test_computes_what_the_cpu_computes(gpu, compute) -> None:
    with sdpa_kernel(STEPS):
        wanted = compute(IMAGE, SQUARE)
    found = compute(IMAGE.to(gpu.device), SQUARE.to(gpu.device))
    assert found.device.type == gpu.device
    assert torch.equal(found.cpu(), wanted)


def test_depth_bins(gpu) -> None:
    rng = np.random.default_rng(0)
    depths = torch.from_numpy(rng.uniform(1, 9, 500).astype(np.float32))
    areas = torch.from_numpy(rng.integers(1, 90, 500))
    weights = torch.from_numpy(rng.dirichlet(np.ones(500), (4, 5)).astype(np.float32))

    def statistics(*tensors: torch.Tensor) -> torch.Tensor:
        depths, areas, weights = tensors
        bins = DepthBins.of(depths, areas)
        return torch.stack(bins.statistics(weights @ bins.channels(depths)))

    wanted = statistics(depths, areas, weights)
    on_device = [tensor.to(gpu.device) for tensor in (depths, areas, weights)]
    gpu.reset()
    found = statistics(*on_device)
    assert (gpu.to_host, gpu.to_device, gpu.waits) == ([], [], []), gpu.explain()
    assert 0 < len(gpu.operations) < 10 * BINS, gpu.explain()
    assert torch.equal(found.cpu(), wanted)


def xfeat(device: str) -> Matcher:
    return XFeatMatcher("", 300, device)


def xfeat_lighterglue(device: str) -> Matcher:
    return LightGlueMatcher(XFeatMatcher, "xfeat", "", 300, device)


def aliked_lightglue(device: str) -> Matcher:
    return LightGlueMatcher(AlikedExtractor, "aliked", "", 300, device)


def disk_lightglue(device: str) -> Matcher:
    return LightGlueMatcher(DiskExtractor, "disk", "", 300, device)


@pytest.mark.parametrize("create", [xfeat, xfeat_lighterglue, aliked_lightglue, disk_lightglue])
def test_learned_matchers(monkeypatch, create) -> None:
    # Of the devices that kornia knows LightGlue drops features on all alike but CUDA.
    monkeypatch.setitem(LightGlue.pruning_keypoint_thresholds, SimulatedGpu.device, -1)
    images = [rectangles(96, 128), shifted(rectangles(96, 128), 3.4, -2.3)]
    on_cpu = create("cpu")
    with sdpa_kernel(STEPS):
        wanted = on_cpu.match(*(on_cpu.features(image) for image in images))
    with simulated_gpu() as gpu:
        on_gpu = create(gpu.device)
        images = [torch.from_numpy(image).to(gpu.device) for image in images]
        gpu.reset()
        a, b = (on_gpu.features(image) for image in images)
        # No picture leaves the device.
        assert max(gpu.to_host, default=0) <= 8, gpu.explain()
        matches = on_gpu.match(a, b)
    assert len(wanted) > 20
    for array in ("a", "b", "scores"):
        np.testing.assert_array_equal(getattr(matches, array), getattr(wanted, array))
