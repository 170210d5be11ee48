"""A slow renderer in torch, written to be read: the oracle of the tests of the fast ones.

Formulas: Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023, and Zwicker et al., "EWA
Splatting", 2002, with the choices of gsplat 1.5.
"""

from __future__ import annotations

import numpy as np
import torch

from gsfeatloc_ros.common.camera import Camera
from gsfeatloc_ros.maps.gaussian_map import GaussianMap
from gsfeatloc_ros.maps.harmonics import harmonics
from gsfeatloc_ros.render.base import (
    DEPTH_MIN_ALPHA,
    EPS2D,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR_PLANE,
    Render,
    SplatRenderer,
    Stage,
)


class ReferenceRenderer(SplatRenderer):
    """Draws a map one Gaussian after another, front to back, in float64."""

    def __init__(self, gaussian_map: GaussianMap, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        super().__init__(gaussian_map)
        self._antialiased = gaussian_map.antialiased
        self._means = torch.from_numpy(gaussian_map.means).double()
        self._covariances = _covariances(gaussian_map)
        self._opacities = torch.from_numpy(gaussian_map.opacities).double()
        self._sh = torch.from_numpy(gaussian_map.sh).double()
        self._background = torch.tensor(background, dtype=torch.float64)

    def _render(self, camera: Camera, T_splat_camera: np.ndarray, stage: Stage) -> Render:
        rotation = torch.from_numpy(T_splat_camera[:3, :3].T.copy()).double()  # splat to camera
        center = torch.from_numpy(T_splat_camera[:3, 3].copy()).double()
        offsets = self._means - center
        points = offsets @ rotation.T  # (N, 3) camera frame
        pixels, sharp_covariances = _project(camera, points, rotation @ self._covariances @ rotation.T)
        covariances = sharp_covariances + EPS2D * torch.eye(2, dtype=torch.float64)
        colors = _colors(self._sh, offsets)
        opacities = self._opacities
        if self._antialiased:
            # As much as the blur widens a Gaussian it dims it (Yu et al., "Mip-Splatting", 2024, eq. 9).
            widening = torch.linalg.det(sharp_covariances) / torch.linalg.det(covariances)
            opacities = opacities * torch.sqrt(widening.clamp(min=0.0))

        # The ellipse outside which alpha is under 1/255.
        reach = torch.sqrt(2.0 * torch.log((opacities / MIN_ALPHA).clamp(min=1.0)))
        radii = reach[:, None] * torch.sqrt(torch.diagonal(covariances, dim1=1, dim2=2))  # (N, 2) pixels
        low = torch.ceil(pixels - radii).clamp(min=0)
        high = torch.floor(pixels + radii)
        high = torch.minimum(high, torch.tensor([camera.width - 1, camera.height - 1]))
        visible = (points[:, 2] > NEAR_PLANE) & (low <= high).all(dim=1) & (opacities >= MIN_ALPHA)

        rgb = torch.zeros(camera.height, camera.width, 3, dtype=torch.float64)
        moments = torch.zeros(camera.height, camera.width, 3, dtype=torch.float64)  # weight, weight z, weight z^2
        transmittance = torch.ones(camera.height, camera.width, dtype=torch.float64)
        median = torch.full((camera.height, camera.width), torch.nan, dtype=torch.float64)
        running = torch.ones(camera.height, camera.width, dtype=torch.bool)

        indices = torch.nonzero(visible).ravel()
        # Sorted by depth in float32, as the fast renderers are, so that ties fall alike.
        indices = indices[torch.argsort(points[indices, 2].float(), stable=True)]
        conics = torch.linalg.inv(covariances[indices])
        for index, conic in zip(indices.tolist(), conics, strict=True):
            (x0, y0), (x1, y1) = low[index].int().tolist(), high[index].int().tolist()
            box = (slice(y0, y1 + 1), slice(x0, x1 + 1))
            dx = torch.arange(x0, x1 + 1) - pixels[index, 0]
            dy = (torch.arange(y0, y1 + 1) - pixels[index, 1])[:, None]
            power = -0.5 * (conic[0, 0] * dx**2 + conic[1, 1] * dy**2) - conic[0, 1] * dx * dy
            alpha = (opacities[index] * torch.exp(power)).clamp(max=MAX_ALPHA)
            after = transmittance[box] * (1.0 - alpha)
            drawn = running[box] & (alpha >= MIN_ALPHA)
            running[box] &= ~(drawn & (after <= MIN_TRANSMITTANCE))
            drawn &= running[box]
            weight = torch.where(drawn, alpha * transmittance[box], 0.0)
            rgb[box] += weight[..., None] * colors[index]
            z = points[index, 2]
            moments[box] += weight[..., None] * torch.stack([torch.ones_like(z), z, z * z])
            halves = drawn & (transmittance[box] > 0.5) & (after <= 0.5)
            median[box] = torch.where(halves, z, median[box])
            transmittance[box] = torch.where(drawn, after, transmittance[box])

        rgb += transmittance[..., None] * self._background
        alpha = 1.0 - transmittance
        depth = moments[..., 1] / moments[..., 0]
        spread = torch.sqrt((moments[..., 2] / moments[..., 0] - depth**2).clamp(min=0.0))
        for image in (depth, median, spread):
            image[alpha < DEPTH_MIN_ALPHA] = torch.nan
        return Render(*(image.float().numpy() for image in (rgb.clamp(max=1.0), depth, median, spread, alpha)))


def _covariances(gaussian_map: GaussianMap) -> torch.Tensor:
    """Return the covariances (N, 3, 3) of the Gaussians in the splat frame: R diag(scale^2) R^T."""
    w, x, y, z = torch.from_numpy(gaussian_map.rotations).double().unbind(1)
    rotation = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
        ],
        1,
    )
    axes = rotation * torch.from_numpy(gaussian_map.scales).double()[:, None, :]
    return axes @ axes.transpose(1, 2)


def _project(camera: Camera, points: torch.Tensor, covariances: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Project Gaussians of the camera frame to pixels (N, 2) and image covariances (N, 2, 2), not blurred.

    EWA, eq. 29-31.
    """
    (fx, _, cx), (_, fy, cy) = camera.K[0], camera.K[1]
    x, y, z = points.unbind(1)
    pixels = torch.stack([fx * x / z + cx, fy * y / z + cy], 1)
    # The linearisation is taken no further than 30 % outside the image, as in gsplat. Its principal point is measured
    # from the image's corner, half a pixel before the centre of the first pixel.
    margin_x, margin_y = 0.3 * 0.5 * camera.width / fx, 0.3 * 0.5 * camera.height / fy
    left, right = (cx + 0.5) / fx + margin_x, (camera.width - cx - 0.5) / fx + margin_x
    top, bottom = (cy + 0.5) / fy + margin_y, (camera.height - cy - 0.5) / fy + margin_y
    tx = z * (x / z).clamp(-left, right)
    ty = z * (y / z).clamp(-top, bottom)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [torch.stack([fx / z, zero, -fx * tx / z**2], 1), torch.stack([zero, fy / z, -fy * ty / z**2], 1)], 1
    )
    return pixels, jacobian @ covariances @ jacobian.transpose(1, 2)


def _colors(sh: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    """Return the colours (N, 3) of harmonics (N, C, 3) seen along offsets (N, 3) from the camera, splat frame."""
    x, y, z = torch.nn.functional.normalize(offsets, dim=1).unbind(1)
    basis = harmonics(x, y, z)
    return (torch.stack(basis[: sh.shape[1]], 1)[:, :, None] * sh).sum(1).add(0.5).clamp(min=0.0)
