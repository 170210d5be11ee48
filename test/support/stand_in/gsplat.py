"""What the documentation of gsplat 1.5 says of the functions that the GPU renderer calls, in float64 on the CPU.

Written from gsplat's docstrings, not from this package's renderers: pixel centres at +0.5, viewmats from the world to
the camera, packed results, lists of Gaussians by tile. Only what the renderer uses of it is here.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def fully_fused_projection(
    means: Tensor,
    covars: Tensor,
    quats: None,
    scales: None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    packed: bool = False,
    calc_compensations: bool = False,
    *,
    opacities: Tensor,
) -> tuple[Tensor, ...]:
    count = len(means)
    assert count > 0  # the real one divides by it
    assert quats is None
    assert scales is None
    assert packed
    assert means.shape == (count, 3)
    assert covars.shape == (count, 6)
    assert opacities.shape == (count,)
    assert viewmats.shape == (1, 4, 4)
    assert Ks.shape == (1, 3, 3)
    for tensor in (means, covars, opacities, viewmats, Ks):
        assert tensor.dtype == torch.float32  # the kernels read nothing else

    world_to_camera, K = viewmats[0].double(), Ks[0].double()
    R, t = world_to_camera[:3, :3], world_to_camera[:3, 3]
    points = means.double() @ R.T + t
    in_front = points[:, 2] >= near_plane
    z = torch.where(in_front, points[:, 2], 1.0)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    centers = torch.stack([fx * points[:, 0] / z + cx, fy * points[:, 1] / z + cy], 1)
    slope_x = (points[:, 0] / z).clamp(-cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
    slope_y = (points[:, 1] / z).clamp(-cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
    J = torch.zeros(count, 2, 3, dtype=torch.float64)
    J[:, 0, 0], J[:, 0, 2] = fx / z, -fx * slope_x / z
    J[:, 1, 1], J[:, 1, 2] = fy / z, -fy * slope_y / z
    upper_triangle = torch.tensor([0, 1, 2, 1, 3, 4, 2, 4, 5])
    covariances = covars.double()[:, upper_triangle].reshape(-1, 3, 3)
    sharp = J @ R @ covariances @ R.T @ J.mT
    blurred = sharp + eps2d * torch.eye(2, dtype=torch.float64)
    compensations = (sharp.det() / blurred.det()).clamp(min=0.0).sqrt()
    seen_opacities = opacities.double() * (compensations if calc_compensations else 1.0)
    deviations = torch.sqrt(2 * torch.log((255 * seen_opacities).clamp(min=1.0)))
    radii = torch.ceil(deviations[:, None] * blurred.diagonal(dim1=1, dim2=2).sqrt())
    size = torch.tensor([width, height])
    inside = ((centers + radii > 0) & (centers - radii < size)).all(1)
    ids = torch.nonzero(in_front & (seen_opacities >= 1 / 255) & (radii > 0).any(1) & inside).ravel()
    inverse = blurred[ids].inverse()
    return (
        torch.zeros_like(ids),
        torch.zeros_like(ids),
        ids,
        radii[ids].int(),
        centers[ids].float(),
        z[ids].float(),
        torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1).float(),
        compensations[ids].float() if calc_compensations else None,
    )


def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor) -> Tensor:
    count = len(dirs)
    assert dirs.shape == (count, 3)
    assert coeffs.shape == (count, coeffs.shape[1], 3)
    assert (degrees_to_use + 1) ** 2 <= coeffs.shape[1]
    assert dirs.dtype == coeffs.dtype == torch.float32
    used = coeffs[:, : (degrees_to_use + 1) ** 2].double()
    return (_harmonics(degrees_to_use, dirs.double()) @ used)[:, 0].float()


def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    packed: bool = False,
    *,
    n_images: int,
    image_ids: Tensor,
    gaussian_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    assert packed
    assert n_images == 1
    assert image_ids.shape == gaussian_ids.shape == depths.shape
    assert image_ids.dtype == gaussian_ids.dtype == torch.int64
    by_depth = torch.argsort(depths, stable=True)
    low = ((means2d - radii) / tile_size).floor()[by_depth]
    high = ((means2d + radii) / tile_size).ceil()[by_depth]
    tile_ids, flatten_ids = [], []
    for row in range(tile_height):
        for column in range(tile_width):
            tile = torch.tensor([column, row])
            flatten_ids.append(by_depth[((low <= tile) & (tile < high)).all(1)])
            tile_ids.append(torch.full_like(flatten_ids[-1], row * tile_width + column))
    tile_ids, flatten_ids = torch.cat(tile_ids), torch.cat(flatten_ids)
    isect_ids = tile_ids << 32 | depths[flatten_ids].view(torch.int32).long()
    return torch.bincount(flatten_ids, minlength=len(depths)).int(), isect_ids, flatten_ids.int()


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    tiles = torch.arange(tile_height * tile_width)
    return torch.searchsorted(isect_ids >> 32, tiles).reshape(n_images, tile_height, tile_width).int()


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    packed: bool = False,
) -> tuple[Tensor, Tensor]:
    count, channels = colors.shape
    assert packed
    assert means2d.shape == (count, 2)
    assert conics.shape == (count, 3)
    assert opacities.shape == (count,)
    for tensor in (means2d, conics, colors, opacities):
        assert tensor.dtype == torch.float32
    columns = isect_offsets.shape[2]
    image = torch.zeros(1, image_height, image_width, channels, dtype=torch.float64)
    alphas = torch.zeros(1, image_height, image_width, 1, dtype=torch.float64)
    ends = [*isect_offsets.ravel()[1:].tolist(), len(flatten_ids)]
    for tile, (start, end) in enumerate(zip(isect_offsets.ravel().tolist(), ends, strict=True)):
        y0, x0 = tile // columns * tile_size, tile % columns * tile_size
        ids = flatten_ids[start:end].long()
        y, x = torch.meshgrid(
            torch.arange(y0, min(y0 + tile_size, image_height)) + 0.5,
            torch.arange(x0, min(x0 + tile_size, image_width)) + 0.5,
            indexing="ij",
        )
        dx, dy = (means2d[ids, axis].double() - grid[..., None] for axis, grid in ((0, x), (1, y)))
        a, b, c = conics[ids].double().unbind(1)
        alpha = opacities[ids].double() * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        alpha = torch.where(alpha < 1 / 255, 0.0, alpha.clamp(max=0.999))
        after = torch.cumprod(1 - alpha, -1)
        drawn = torch.cumsum((after <= 1e-4).int(), -1) == 0
        before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], -1)
        weights = torch.where(drawn, alpha * before, 0.0)
        box = (0, slice(y0, y0 + tile_size), slice(x0, x0 + tile_size))
        image[box] = weights @ colors[ids].double()
        alphas[box] = weights.sum(-1, keepdim=True)
    assert isect_offsets.shape[1:] == (math.ceil(image_height / tile_size), math.ceil(image_width / tile_size))
    return image.float(), alphas.float()


def _harmonics(degree: int, directions: Tensor) -> Tensor:
    """Real spherical harmonics (N, 1, (degree + 1)^2) by their definition, with the Condon-Shortley phase."""
    x, y, z = torch.nn.functional.normalize(directions, dim=1).unbind(1)
    azimuth, sine = torch.atan2(y, x), torch.sqrt((1 - z * z).clamp(min=0.0))
    legendre = {(0, 0): torch.ones_like(z)}
    for m in range(degree + 1):
        if m:
            legendre[m, m] = -(2 * m - 1) * sine * legendre[m - 1, m - 1]
        for n in range(m + 1, degree + 1):
            lower = (n + m - 1) * legendre[n - 2, m] if n - 2 >= m else 0.0
            legendre[n, m] = ((2 * n - 1) * z * legendre[n - 1, m] - lower) / (n - m)
    values = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            ratio = math.factorial(n - abs(m)) / math.factorial(n + abs(m))
            turn = 1.0 if m == 0 else math.sqrt(2) * (torch.cos(m * azimuth) if m > 0 else torch.sin(-m * azimuth))
            values.append(math.sqrt((2 * n + 1) / (4 * math.pi) * ratio) * legendre[n, abs(m)] * turn)
    return torch.stack(values, 1)[:, None]
