"""The renderer for robots with an NVIDIA GPU: gsplat (https://docs.gsplat.studio), which is optional."""

from __future__ import annotations

import functools
import threading

import numpy as np
import torch

from gsfeatloc_ros.common.arrays import to_device
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap
from gsfeatloc_ros.render import prepare as prepared_rows
from gsfeatloc_ros.render.base import DEPTH_MIN_ALPHA, EPS2D, NEAR_PLANE, Render, SplatRenderer, check_range
from gsfeatloc_ros.render.cpu import CpuRenderer
from gsfeatloc_ros.render.depth_bins import Slabs
from gsfeatloc_ros.render.enlarge import draw_scaled
from gsfeatloc_ros.render.prepare import PreparedMap, prepare

# What the pictures of the self-check must agree in with the CPU's. Rounding leaves more than 60 dB; half a pixel or a
# mirrored axis, less than 40.
CHECK_MIN_PSNR = 50.0
CHECK_MAX_DEPTH_ERROR = 1e-3
_CHECK_CAMERA = Camera(80, 56, np.array([[60.0, 0, 43.0], [0, 64.0, 26.0], [0, 0, 1]]))
# The upper triangle of a covariance, as gsplat takes it.
_COVARIANCE = [
    prepared_rows.XX, prepared_rows.XY, prepared_rows.XZ, prepared_rows.YY, prepared_rows.YZ, prepared_rows.ZZ
]  # fmt: skip
_TILE = 16  # pixels; gsplat says that no other size is tested


class GpuRenderer(SplatRenderer):
    """Rasterizer on a GPU, with the conventions and outputs of CpuRenderer but for two.

    Renders stay on the GPU, for matchers and trackers there; those enlarged (resolution_scale) come to the host.

    gsplat gives no median depth. It is estimated, to within some thousandths of the depth, from the moments of the
    depth in slabs (render/slabs.py); the mean and the spread are exact.
    """

    def __init__(
        self,
        gaussian_map: GaussianMap | PreparedMap,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        sh_degree: int = 3,
        resolution_scale: float = 1.0,
        device: str = "cuda",
    ) -> None:
        """See `create_renderer`; `device` is torch's. The first on a device draws two small pictures to check it.

        Raises:
            ValueError: a number out of its range.
            RuntimeError: gsplat does not work on the device, or draws other pictures than the CPU does.
        """
        check_range("sh_degree", sh_degree, 0, len(SH_COEFFICIENTS) - 1)
        check_range("resolution_scale", resolution_scale, 0.1, 1.0)
        super().__init__(gaussian_map, device)
        problem = self_check(device)
        if problem:
            raise RuntimeError(problem)
        self._resolution_scale = resolution_scale
        self._splats = _Splats(gaussian_map, background, sh_degree, device)
        # One frame at a time: two would take twice the memory.
        self._lock = threading.Lock()

    def _render(self, camera: Camera, T_splat_camera: np.ndarray) -> Render:
        with self._lock:
            return draw_scaled(self._splats.draw, camera, T_splat_camera, self._resolution_scale)


class _Splats:
    """The Gaussians of a map on a device, and gsplat's calls that draw them."""

    def __init__(
        self,
        gaussian_map: GaussianMap | PreparedMap,
        background: tuple[float, float, float],
        sh_degree: int,
        device: str,
    ) -> None:
        prepared = gaussian_map if isinstance(gaussian_map, PreparedMap) else prepare(gaussian_map)
        stored = prepared.sh.shape[1] // 3
        used = min(stored, SH_COEFFICIENTS[sh_degree])
        self._sh_degree = SH_COEFFICIENTS.index(used)
        self._antialiased = prepared.antialiased
        self._background = torch.tensor(background, dtype=torch.float32, device=device)
        rows = to_device(prepared.gaussians, device).transpose(1, 2).reshape(-1, prepared_rows.ROWS)
        # Those that fill up the last chunk have no opacity.
        seen = torch.isfinite(rows[:, prepared_rows.LOG_OPACITY])
        rows = rows[seen]
        self._means = rows[:, : prepared_rows.Z + 1].contiguous()
        self._covariances = rows[:, _COVARIANCE]
        self._opacities = torch.exp2(rows[:, prepared_rows.LOG_OPACITY])
        sh = to_device(prepared.sh[:, : 3 * used], device).transpose(1, 2).reshape(-1, used, 3)
        self._sh = sh[seen]  # in half precision

    @torch.no_grad()
    def draw(self, camera: Camera, T_splat_camera: np.ndarray) -> Render:
        """As SplatRenderer._render."""
        if len(self._means) == 0:
            return self._nothing(camera)
        import gsplat

        device = self._means.device
        center = T_splat_camera[:3, 3]
        origin = center.astype(np.float32)
        view = np.eye(4)
        view[:3, :3] = T_splat_camera[:3, :3].T
        K = camera.K.copy()
        # gsplat counts pixels from the image's corner, half a pixel before the centre of the first.
        K[:2, 2] += 0.5
        # In one copy.
        numbers = np.concatenate([origin, center - origin, view.ravel(), K.ravel()]).astype(np.float32)
        origin, rest, view, K = to_device(numbers, device).split([3, 3, 16, 9])
        # Relative to the camera, so that a map far from its origin loses no digits in gsplat's float32.
        offsets = self._means - origin - rest
        _, cameras, seen, radii, means2d, depths, conics, compensations = gsplat.fully_fused_projection(
            means=offsets,
            covars=self._covariances,
            quats=None,
            scales=None,
            viewmats=view.view(1, 4, 4),
            Ks=K.view(1, 3, 3),
            width=camera.width,
            height=camera.height,
            eps2d=EPS2D,
            near_plane=NEAR_PLANE,
            packed=True,
            calc_compensations=self._antialiased,
            opacities=self._opacities,
        )
        if len(seen) == 0:
            return self._nothing(camera)
        opacities = self._opacities[seen]
        if self._antialiased:
            opacities = opacities * compensations
        colors = gsplat.spherical_harmonics(
            degrees_to_use=self._sh_degree, dirs=offsets[seen], coeffs=self._sh[seen].float()
        )
        columns, rows = (-(-size // _TILE) for size in (camera.width, camera.height))
        _, isect_ids, flatten_ids = gsplat.isect_tiles(
            means2d, radii, depths, _TILE, columns, rows, packed=True, n_images=1, image_ids=cameras, gaussian_ids=seen
        )
        slabs = Slabs.of(depths, radii.long().clamp(max=max(camera.width, camera.height)).prod(1))
        # Colours and moments of the depth in one pass; 33 channels are one of the numbers that gsplat has kernels for.
        blended, alpha = gsplat.rasterize_to_pixels(
            means2d,
            conics,
            torch.cat([(colors + 0.5).clamp(min=0.0), slabs.channels(depths)], dim=1),
            opacities,
            camera.width,
            camera.height,
            _TILE,
            gsplat.isect_offset_encode(isect_ids, 1, columns, rows),
            flatten_ids,
            packed=True,
        )
        # Here and not by gsplat, which in 1.5.3 takes no background of packed splats.
        rgb = blended[0, ..., :3] + (1.0 - alpha[0]) * self._background
        alpha = alpha[0, ..., 0]
        bare = alpha < DEPTH_MIN_ALPHA
        depths = (image.masked_fill(bare, torch.nan) for image in slabs.statistics(blended[0, ..., 3:]))
        return Render(rgb.clamp(max=1.0), *depths, alpha)

    def _nothing(self, camera: Camera) -> Render:
        shape, device = (camera.height, camera.width), self._means.device
        rgb = self._background.expand(*shape, 3).clone()
        depths = (torch.full(shape, torch.nan, device=device) for _ in range(3))
        return Render(rgb, *depths, torch.zeros(shape, device=device))


@functools.cache
def self_check(device: str) -> str:
    """What is wrong with gsplat on a device of torch's; empty where it draws a small made-up map as the CPU does."""
    try:
        for antialiased in (False, True):
            gaussian_map = _check_map(antialiased)
            gpu = _Splats(gaussian_map, (0.2, 0.4, 0.6), 3, device).draw(_CHECK_CAMERA, np.eye(4)).on_host()
            cpu = CpuRenderer(gaussian_map, background=(0.2, 0.4, 0.6))._draw(_CHECK_CAMERA, np.eye(4))
            difference = _difference(gpu, cpu)
            if difference:
                return (
                    f"gsplat draws wrong pictures on this machine ({difference}), which would give wrong poses: "
                    "install gsplat>=1.5.3,<1.6, or render on the CPU"
                )
    except Exception as error:  # whatever it is, gsplat cannot be used, and the caller is to hear why
        return (
            f"gsplat does not work on this machine ({type(error).__name__}: {error}): it builds itself when first "
            "used, with g++ and the CUDA toolkit of the version that torch is built for; nvcc and ninja must be on the "
            "PATH then and later"
        )
    return ""


def _difference(gpu: Render, cpu: Render) -> str:
    """In what two pictures differ by more than rounding; empty where in nothing."""
    psnr = -10.0 * np.log10(np.mean((gpu.rgb.astype(np.float64) - cpu.rgb) ** 2) + 1e-20)
    # Comparisons with NaN are false: what is not a number is no agreement.
    if not psnr >= CHECK_MIN_PSNR:
        return f"{psnr:.1f} dB from the CPU's, {CHECK_MIN_PSNR:g} at least"
    if not np.mean(np.abs(gpu.alpha - cpu.alpha) < 0.01) > 0.99:
        return "coverage is off"
    both = np.isfinite(gpu.depth) & np.isfinite(cpu.depth)
    if not np.mean(both) > 0.98 * np.mean(np.isfinite(cpu.depth)):
        return "depth is missing"
    for name in ("depth", "depth_std"):
        error = np.quantile(np.abs(getattr(gpu, name) - getattr(cpu, name))[both] / cpu.depth[both], 0.98)
        if not error <= CHECK_MAX_DEPTH_ERROR:
            return f"{name} is off by {error:.2g} of the depth, {CHECK_MAX_DEPTH_ERROR:g} at most"
    return ""


def _check_map(antialiased: bool) -> GaussianMap:
    """Gaussians of all colours, sizes and shapes that fill the view of _CHECK_CAMERA."""
    rng = np.random.default_rng(0)
    count = 500
    rotations = rng.normal(size=(count, 4))
    z = rng.uniform(1.0, 4.0, count)
    means = np.column_stack([rng.uniform(-0.8, 0.8, count) * z, rng.uniform(-0.55, 0.55, count) * z, z])
    return GaussianMap(
        means=means.astype(np.float32),
        scales=np.exp(rng.uniform(-5.0, -1.5, (count, 3))).astype(np.float32),
        rotations=(rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        opacities=rng.uniform(0.2, 1.0, count).astype(np.float32),
        sh=rng.normal(scale=0.4, size=(count, 16, 3)).astype(np.float32),
        antialiased=antialiased,
    )
