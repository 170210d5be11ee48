"""The CPU renderer against that of OpenSplat, which is built from a checkout of its sources, on the same frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.cpp_extension import load_inline

from gsfeatloc_ros.benchmark.frames import UNCOUNTED_FRAMES
from gsfeatloc_ros.benchmark.measure import Timed, spread, timed
from gsfeatloc_ros.common.arrays import to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.common.geometry import invert
from gsfeatloc_ros.maps import GaussianMap
from gsfeatloc_ros.render import create_renderer

_RASTERIZER = Path("rasterizer", "gsplat-cpu", "gsplat_cpu.cpp")
# As Model::forward of OpenSplat's model.cpp calls it, but for one thing: the depths are a column of a wider array, and
# the rasterizer reads them as if they lay one behind another. Without a copy it draws the splats in no order at all.
_GLUE = """
torch::Tensor render(torch::Tensor means, torch::Tensor log_scales, torch::Tensor rotations, torch::Tensor logits,
                     torch::Tensor sh, torch::Tensor view, torch::Tensor projection, torch::Tensor center, double fx,
                     double fy, double cx, double cy, int64_t height, int64_t width) {
    torch::NoGradGuard no_grad;
    torch::Tensor scales = torch::exp(log_scales), both = torch::matmul(projection, view);
    auto [xys, radii, conics, covariances, depths] = project_gaussians_forward_tensor_cpu(
        means.size(0), means, scales, 1.0f, rotations, view, both, fx, fy, cx, cy, height, width, 0.01f);
    torch::Tensor directions = means - center;
    directions = directions / directions.norm(2, {-1}, true);
    int degree = std::lround(std::sqrt(sh.size(1))) - 1;
    torch::Tensor colors = compute_sh_forward_tensor_cpu(means.size(0), degree, degree, directions, sh);
    auto [image, transmittance, lists] = rasterize_forward_tensor_cpu(
        width, height, xys, conics, torch::clamp_min(colors + 0.5f, 0.0f), torch::sigmoid(logits),
        torch::zeros({3}), covariances, depths.contiguous());
    delete[] lists;
    return torch::clamp_max(image, 1.0f);
}
"""
_NEAR, _FAR = 0.001, 1000.0


def measure_against_opensplat(
    checkout: Path, gaussian_map: GaussianMap, camera: Camera, poses: Sequence[np.ndarray], threads: int
) -> dict[str, Any]:
    """Draw frames at `poses`, (4, 4) T_map_camera each, with this package's CPU renderer and with OpenSplat's in turns.

    Args:
        checkout: folder of https://github.com/pierotofy/OpenSplat.
        gaussian_map: a map in its own frame.
        threads: of this package's renderer. OpenSplat's projects with all cores and blends with one.

    Returns:
        CPU and wall milliseconds of both (min and median), OpenSplat's CPU median over ours, and the PSNR between the
        pictures in dB.

    Raises:
        ValueError: the map was trained antialiased, which OpenSplat cannot draw.
        OSError: OpenSplat's sources are not there.
        RuntimeError: they cannot be built.
    """
    if gaussian_map.antialiased:
        raise ValueError("the map was trained antialiased, which OpenSplat cannot draw")
    theirs = _opensplat(checkout, gaussian_map, camera)
    renderer = create_renderer(gaussian_map, "cpu", threads)
    draw: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "ours": lambda pose: to_host(renderer.render(camera, pose).rgb),
        "opensplat": theirs,
    }
    for pose in poses[:UNCOUNTED_FRAMES]:
        for function in draw.values():
            function(pose)
    frames: dict[str, list[Timed[np.ndarray]]] = {name: [] for name in draw}
    for pose in poses:
        for name, function in draw.items():
            frames[name].append(timed(function, pose))
    squares = [np.mean((a.result - b.result) ** 2) for a, b in zip(*frames.values(), strict=True)]
    report = {
        name: {"cpu_ms": spread([frame.cpu for frame in done]), "wall_ms": spread([frame.wall for frame in done])}
        for name, done in frames.items()
    }
    return report | {
        "gaussians": len(gaussian_map),
        "size": [camera.width, camera.height],
        "frames": len(poses),
        "ratio": report["opensplat"]["cpu_ms"]["median"] / report["ours"]["cpu_ms"]["median"],
        "psnr_db": float(-10 * np.log10(np.mean(squares))),
    }


def print_against_opensplat(report: dict[str, Any]) -> None:
    """Print what measure_against_opensplat found."""
    width, height = report["size"]
    print(f"{report['gaussians']} Gaussians, {width}x{height}, {report['frames']} frames")
    for name in ("ours", "opensplat"):
        cpu, wall = report[name]["cpu_ms"], report[name]["wall_ms"]
        print(f"  {name:9}  CPU ms: min {cpu['min']:7.1f}  median {cpu['median']:7.1f}   wall: {wall['median']:7.1f}")
    print(f"  OpenSplat takes {report['ratio']:.0f} times the CPU time; PSNR between both {report['psnr_db']:.1f} dB")


def _opensplat(checkout: Path, gaussian_map: GaussianMap, camera: Camera) -> Callable[[np.ndarray], np.ndarray]:
    """Return OpenSplat as a function that draws the map from a pose (4, 4) as RGB (H, W, 3) on black."""
    rasterizer = (checkout / _RASTERIZER).resolve()
    if not rasterizer.is_file():
        raise FileNotFoundError(f"{rasterizer} is missing: is {checkout} a checkout of OpenSplat?")
    built = load_inline(
        "opensplat_cpu",
        f'#include "{rasterizer}"\n{_GLUE}',
        functions=["render"],
        extra_cflags=["-O3", "-march=native"],
    )
    means, scales, rotations, opacities, sh = (
        torch.from_numpy(values)
        for values in (
            gaussian_map.means,
            gaussian_map.scales,
            gaussian_map.rotations,
            gaussian_map.opacities,
            gaussian_map.sh,
        )
    )
    parameters = (means, torch.log(scales), rotations, torch.logit(opacities)[:, None], sh)
    (fx, _, cx), (_, fy, cy) = camera.K[0], camera.K[1]
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[0, 2] = 2 * fx / camera.width, (2 * cx + 1) / camera.width - 1
    projection[1, 1], projection[1, 2] = 2 * fy / camera.height, (2 * cy + 1) / camera.height - 1
    projection[2, 2], projection[2, 3] = (_FAR + _NEAR) / (_FAR - _NEAR), -_FAR * _NEAR / (_FAR - _NEAR)
    projection[3, 2] = 1.0

    def draw(T_map_camera: np.ndarray) -> np.ndarray:
        view = torch.from_numpy(invert(T_map_camera)).float()
        center = torch.from_numpy(T_map_camera[:3, 3]).float()
        image = built.render(*parameters, view, projection, center, fx, fy, cx, cy, camera.height, camera.width)
        return image.numpy()

    return draw
