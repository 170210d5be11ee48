"""The renderer for robots with an NVIDIA GPU: gsplat (https://docs.gsplat.studio), which is optional."""

from __future__ import annotations

import functools
import threading
from functools import partial

import numpy as np
import torch

from gsfeatloc_ros.common.arrays import to_device, to_host
from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps.gaussian_map import SH_COEFFICIENTS, GaussianMap
from gsfeatloc_ros.render.base import (
    DEFAULT_DRAW_OPTIONS,
    DEPTH_MIN_ALPHA,
    EPS2D,
    NEAR_PLANE,
    DrawOptions,
    Render,
    SplatRenderer,
    Stage,
    unmeasured,
)
from gsfeatloc_ros.render.chunks import PreparedMap
from gsfeatloc_ros.render.cpu import CpuRenderer
from gsfeatloc_ros.render.depth_bins import DepthBins
from gsfeatloc_ros.render.enlarge import draw_scaled
from gsfeatloc_ros.render.prepare import prepare

# What the pictures of the self-check must agree in with the CPU's. Rounding leaves more than 60 dB; half a pixel or a
# mirrored axis, less than 40.
CHECK_MIN_PSNR = 50.0
CHECK_MAX_DEPTH_ERROR = 1e-3
_CHECK_CAMERA = Camera(80, 56, np.array([[60.0, 0, 43.0], [0, 64.0, 26.0], [0, 0, 1]]))
_CHECK_OPTIONS = DrawOptions(background=(0.2, 0.4, 0.6))
_TILE_SIZE = 16  # pixels; gsplat says that no other size is tested


class GpuRenderer(SplatRenderer):
    """Rasterizer on a GPU, with the conventions and outputs of CpuRenderer. Renders stay on the GPU.

    gsplat gives no median depth. It is estimated, to within some thousandths of the depth, from the moments of the
    depth in bins (render/depth_bins.py); the mean and the spread are exact.
    """

    def __init__(
        self,
        gaussian_map: GaussianMap | PreparedMap,
        options: DrawOptions = DEFAULT_DRAW_OPTIONS,
        device: str = "cuda",
    ) -> None:
        """Bring a map to a device of torch's; see `create_renderer`. The first on a device draws two to check it.

        Raises:
            RuntimeError: gsplat does not work on the device, or draws other pictures than the CPU does.
        """
        super().__init__(gaussian_map, device)
        problem = self_check(device)
        if problem:
            raise RuntimeError(problem)
        self._resolution_scale = options.resolution_scale
        self._map = _DeviceMap(gaussian_map, options, device)
        # One frame at a time: two would take twice the memory.
        self._lock = threading.Lock()

    def _render(self, camera: Camera, T_splat_camera: np.ndarray, stage: Stage) -> Render:
        with self._lock:
            return draw_scaled(partial(self._map.draw, stage=stage), camera, T_splat_camera, self._resolution_scale)


class _DeviceMap:
    """The Gaussians of a map on a device, and gsplat's calls that draw them."""

    def __init__(self, gaussian_map: GaussianMap | PreparedMap, options: DrawOptions, device: str) -> None:
        prepared = gaussian_map if isinstance(gaussian_map, PreparedMap) else prepare(gaussian_map)
        gaussians = prepared.unpacked(options.sh_degree)
        self._sh_degree = SH_COEFFICIENTS.index(gaussians.sh.shape[1])
        self._antialiased = prepared.antialiased
        self._background = torch.tensor(options.background, dtype=torch.float32, device=device)
        self._means = to_device(gaussians.means, device)
        self._covariances = to_device(gaussians.covariances, device)
        self._opacities = to_device(gaussians.opacities, device)
        self._sh = to_device(gaussians.sh, device)  # in half precision

    @torch.no_grad()
    def draw(self, camera: Camera, T_splat_camera: np.ndarray, stage: Stage) -> Render:
        """Do as SplatRenderer._render."""
        if len(self._means) == 0:
            return self._nothing(camera)
        import gsplat

        offsets, view, K = self._seen_from(camera, T_splat_camera)
        with stage("project"):
            _, cameras, seen, radii, means2d, depths, conics, compensations = gsplat.fully_fused_projection(
                means=offsets,
                covars=self._covariances,
                quats=None,
                scales=None,
                viewmats=view[None],
                Ks=K[None],
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
        with stage("colour"):
            colors = gsplat.spherical_harmonics(
                degrees_to_use=self._sh_degree, dirs=offsets[seen], coeffs=self._sh[seen].float()
            )
        columns, rows = (-(-size // _TILE_SIZE) for size in (camera.width, camera.height))
        with stage("tiles and sort"):
            _, isect_ids, flatten_ids = gsplat.isect_tiles(
                means2d,
                radii,
                depths,
                _TILE_SIZE,
                columns,
                rows,
                packed=True,
                n_images=1,
                image_ids=cameras,
                gaussian_ids=seen,
            )
            starts_of_tiles = gsplat.isect_offset_encode(isect_ids, 1, columns, rows)
        bins = DepthBins.of(depths, radii.long().clamp(max=max(camera.width, camera.height)).prod(1))
        # Colours and moments of the depth in one pass; 33 channels are one of the numbers that gsplat has kernels for.
        channels = torch.cat([(colors + 0.5).clamp(min=0.0), bins.channels(depths)], dim=1)
        with stage("blend"):
            blended, alpha = gsplat.rasterize_to_pixels(
                means2d,
                conics,
                channels,
                opacities,
                camera.width,
                camera.height,
                _TILE_SIZE,
                starts_of_tiles,
                flatten_ids,
                packed=True,
            )
        # Here and not by gsplat, which in 1.5.3 takes no background of packed splats.
        rgb = blended[0, ..., :3] + (1.0 - alpha[0]) * self._background
        alpha = alpha[0, ..., 0]
        bare = alpha < DEPTH_MIN_ALPHA
        mean, median, deviation = (
            picture.masked_fill(bare, torch.nan) for picture in bins.statistics(blended[0, ..., 3:])
        )
        return Render(rgb.clamp(max=1.0), mean, median, deviation, alpha)

    def _seen_from(self, camera: Camera, T_splat_camera: np.ndarray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the means (N, 3) about the camera's centre, its rotation as gsplat's view (4, 4), and its K (3, 3)."""
        center = T_splat_camera[:3, 3]
        rounded_center = center.astype(np.float32)
        world_to_camera = np.eye(4)
        world_to_camera[:3, :3] = T_splat_camera[:3, :3].T
        intrinsics = camera.K.copy()
        # gsplat counts pixels from the image's corner, half a pixel before the centre of the first.
        intrinsics[:2, 2] += 0.5
        numbers = np.concatenate([rounded_center, center - rounded_center, world_to_camera.ravel(), intrinsics.ravel()])
        # In one copy.
        origin, rest, view, K = to_device(numbers.astype(np.float32), self._means.device).split([3, 3, 16, 9])
        # Relative to the camera, so that a map far from its origin loses no digits in gsplat's float32.
        return self._means - origin - rest, view.view(4, 4), K.view(3, 3)

    def _nothing(self, camera: Camera) -> Render:
        shape, device = (camera.height, camera.width), self._means.device
        rgb = self._background.expand(*shape, 3).clone()
        mean, median, deviation = (torch.full(shape, torch.nan, device=device) for _ in range(3))
        return Render(rgb, mean, median, deviation, torch.zeros(shape, device=device))


@functools.cache
def self_check(device: str) -> str:
    """Return what is wrong with gsplat on a device of torch's; "" where it draws small made-up maps as the CPU does."""
    try:
        for antialiased in (False, True):
            gaussian_map = _check_map(antialiased)
            gpu = _DeviceMap(gaussian_map, _CHECK_OPTIONS, device).draw(_CHECK_CAMERA, np.eye(4), unmeasured)
            cpu = CpuRenderer(gaussian_map, options=_CHECK_OPTIONS).render(_CHECK_CAMERA, np.eye(4))
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
    """Return in what two renders differ by more than rounding; "" where in nothing."""
    squares = (to_host(gpu.rgb).astype(np.float64) - to_host(cpu.rgb)) ** 2
    psnr = -10.0 * np.log10(np.mean(squares) + 1e-20)
    # Comparisons with NaN are false: what is not a number is no agreement.
    if not psnr >= CHECK_MIN_PSNR:
        return f"{psnr:.1f} dB from the CPU's, {CHECK_MIN_PSNR:g} at least"
    if not np.mean(np.abs(to_host(gpu.alpha) - to_host(cpu.alpha)) < 0.01) > 0.99:
        return "coverage is off"
    cpu_depth = to_host(cpu.depth)
    both = np.isfinite(to_host(gpu.depth)) & np.isfinite(cpu_depth)
    if not np.mean(both) > 0.98 * np.mean(np.isfinite(cpu_depth)):
        return "depth is missing"
    for name in ("depth", "depth_std"):
        error = np.abs(to_host(getattr(gpu, name)) - to_host(getattr(cpu, name)))[both] / cpu_depth[both]
        if not np.quantile(error, 0.98) <= CHECK_MAX_DEPTH_ERROR:
            return f"{name} is off by {np.quantile(error, 0.98):.2g} of the depth, {CHECK_MAX_DEPTH_ERROR:g} at most"
    return ""


def _check_map(antialiased: bool) -> GaussianMap:
    """Make up Gaussians of all colours, sizes and shapes that fill the view of _CHECK_CAMERA."""
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
