"""Following the corners of a photo into renders that lie on a GPU."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch.nn.functional import avg_pool2d, conv2d, grid_sample, max_pool2d, pad

from gsfeatloc_ros.common.arrays import Array, to_device, to_host
from gsfeatloc_ros.common.photo import Photo
from gsfeatloc_ros.match.base import Matches, Worth, all_of_them
from gsfeatloc_ros.match.corners import CORNER_BLOCK, MIN_CORNER_DISTANCE, MIN_CORNER_QUALITY
from gsfeatloc_ros.match.flow import MAX_LEVEL, WINDOW
from gsfeatloc_ros.match.tensor import LUMA
from gsfeatloc_ros.match.track import (
    MAX_CORNERS,
    MAX_RETURN_ERROR,
    STRUCTURE_GAIN,
    STRUCTURE_MIN_CONTRAST,
    STRUCTURE_SIGMA,
    seen_off_the_border,
)

# Peaks that are looked at for corners. There is about one in 25 pixels, a corner needs 50 to 80 for itself.
_MAX_CANDIDATES = 4 * MAX_CORNERS
# How often it is decided which of them are corners. Odd, so that none of those left undecided is taken.
_SUPPRESSION_ROUNDS = 9
# Steps on the coarsest level, where the way is long, and on each other.
_FLOW_STEPS_COARSEST = 25
_FLOW_STEPS = 12
# Part of each step that is taken: in an image of twice the contrast, whole ones would lead to and fro for ever.
_STEP_FRACTION = 0.75
# Of 255; beyond it the bytes of CornerTracker have no values.
_MAX_STRUCTURE = 128.0
# OpenCV's 1e-4, which it compares with a 1024th of the mean of the squared gradients.
_MIN_EIGENVALUE = 0.1024
# Smoothing across and derivative along an axis.
_SOBEL = ((1, 2, 1), (-1, 0, 1))
_SCHARR = ((3 / 16, 10 / 16, 3 / 16), (-1 / 2, 0, 1 / 2))
_HALVING_KERNEL = np.array([1, 4, 6, 4, 1]) / 16


class GpuCornerTracker:
    """CornerTracker on a device of torch's, for renders that lie there; only what is found comes to the host.

    It finds the same to some hundredths of a pixel: local structure is not rounded to bytes here, and all corners take
    the same number of smaller steps. (Bicubic interpolation, torch's with a = -0.75, would be worse than bilinear: it
    is biased towards whole pixels, by up to 0.03.)

    Attributes:
        corners: (N, 2) float32 pixels of the photo.
    """

    def __init__(self, photo: Photo, device: str) -> None:
        self._photo, self._device = photo, device
        self._constants = _constants(*photo.seen.shape, device)
        with torch.inference_mode():
            gray = self._constants.gray(photo.image)
            seen = to_device(seen_off_the_border(photo), device)
            self.corners = _find_corners(gray, seen, self._constants.sobel)
            if len(self.corners) > 0:
                self._pixels = to_device(self.corners, device)
                self._pyramid = self._constants.pyramid(gray)
                self._templates = [level.templates(self._pixels) for level in self._pyramid]

    @torch.inference_mode()
    def track(self, image: Array, worth: Worth = all_of_them) -> Matches:
        """Find the photo's corners in a render (H, W, 3) uint8 RGB of its size.

        Corners that cannot be followed there and back are left out. None takes time of its own: `worth` is not asked.
        """
        if len(self.corners) == 0:
            return Matches.none()
        pyramid = self._constants.pyramid(self._constants.gray(image))
        last_pixel = self._constants.last_pixel
        there, found = _flow(self._templates, pyramid, self._pixels, last_pixel)
        back, found_back = _flow([level.templates(there) for level in pyramid], self._pyramid, there, last_pixel)
        kept = found & found_back & ((back - self._pixels).norm(dim=1) <= MAX_RETURN_ERROR)
        # One copy, as each waits for the device.
        x, y, kept = torch.cat([there, kept[:, None]], dim=1).cpu().numpy().T
        kept = kept > 0
        pixels = self.corners[kept].astype(np.float64)
        return Matches(pixels, np.column_stack([x, y])[kept].astype(np.float64), np.ones(len(pixels)))

    def track_back(self, image: Array, worth: Worth = all_of_them) -> Matches:
        """Find the corners of a render (H, W, 3) uint8 RGB in the photo; `a` of the matches are the photo's pixels."""
        render = Photo(to_host(image), np.ones(self._photo.seen.shape, bool), self._photo.camera)
        return GpuCornerTracker(render, self._device).track(self._photo.image).swapped()


def _flow(
    templates: list[_Templates], pyramid: list[_Level], pixels: torch.Tensor, last_pixel: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Find where `templates` of the pixels (N, 2) of one image are in another: (N, 2), and which were found (N,) bool.

    By the iteration of Lucas and Kanade, from the coarsest level to the finest. All corners take the same number of
    steps: those that are there stay, and the host need not ask the device which they are.
    """
    moved = pixels
    for level, template in reversed(list(zip(pyramid, templates, strict=True))):
        for _ in range(_FLOW_STEPS_COARSEST if level is pyramid[-1] else _FLOW_STEPS):
            difference = template.values - level.values(moved)
            moved = torch.baddbmm(moved[..., None], template.steps, difference[..., None], alpha=_STEP_FRACTION)[..., 0]
    inside = ((moved >= 0) & (moved <= last_pixel)).all(dim=1)
    return moved, inside & templates[0].textured


def _find_corners(gray: torch.Tensor, seen: torch.Tensor, sobel: torch.Tensor) -> np.ndarray:
    """Find the strongest corners (N, 2) float32 of brightness (H, W) where `seen` (H, W), as match/corners.py."""
    gx, gy = _filtered(gray, sobel)[0]
    around = pad(torch.stack([gx * gx, gx * gy, gy * gy])[None], [CORNER_BLOCK // 2] * 4, mode="replicate")
    strength = _least_eigenvalue(*avg_pool2d(around, CORNER_BLOCK, 1)[0]) * seen
    # On the border there is no peak.
    highest = max_pool2d(pad(strength, (1, 1, 1, 1), value=torch.inf)[None], 3, 1)[0]
    peaks = (strength * (strength == highest)).flatten()
    strengths, indices = peaks.topk(min(_MAX_CANDIDATES, len(peaks)))
    width = gray.shape[1]
    pixels = torch.stack([indices % width, indices // width], dim=1).float()
    strong = strengths > MIN_CORNER_QUALITY * strengths[0]

    # A candidate is a corner unless a stronger corner is near: known at once of those that are the strongest around, of
    # others when it is known of those.
    near = torch.cdist(pixels, pixels, compute_mode="donot_use_mm_for_euclid_dist") < MIN_CORNER_DISTANCE
    ruled_out_by = near.tril(-1).float()
    corners = strong
    for _ in range(_SUPPRESSION_ROUNDS):
        corners = strong & (ruled_out_by @ corners.float() == 0)
    x, y, corners = torch.cat([pixels, corners[:, None]], dim=1).cpu().numpy().T
    return np.column_stack([x, y])[corners > 0][:MAX_CORNERS]


@dataclass(frozen=True, eq=False)
class _Templates:
    """What the surroundings of N corners look like on a level of the pyramid.

    Attributes:
        values: (N, P) of the P pixels of a window.
        steps: (N, 2, P) pixels of the whole image that the corner moves by where a value is less by 1: the inverse of
            the gradient's second moments, times the gradient. Zeros without texture.
        textured: (N,) bool, whether there is gradient in all directions.
    """

    values: torch.Tensor
    steps: torch.Tensor
    textured: torch.Tensor


@dataclass(frozen=True, eq=False)
class _Scale:
    """The coordinates of a level of the pyramid as grid_sample takes them: the outermost pixels' centres are -1 and 1.

    Attributes:
        pixel: of this level, in pixels of the whole image.
        window: (P, 2) where a window's pixels are when its middle is at the image's first pixel.
        per_pixel: (2,) what a pixel of the whole image is.
    """

    pixel: int
    window: torch.Tensor
    per_pixel: torch.Tensor


@dataclass(frozen=True, eq=False)
class _Level:
    """A level of the pyramid: structure (1, 1, H, W) and its gradient (1, 2, H, W)."""

    structure: torch.Tensor
    gradient: torch.Tensor
    scale: _Scale

    def values(self, pixels: torch.Tensor) -> torch.Tensor:
        """Return the windows (N, P) round `pixels` (N, 2) of the whole image; outside, the level is reflected."""
        grid = self._grid(pixels)
        return grid_sample(self.structure, grid, padding_mode="reflection", align_corners=True)[0, 0]

    def templates(self, pixels: torch.Tensor) -> _Templates:
        """Return the windows round `pixels` (N, 2) of the whole image, to be followed; outside there is no gradient."""
        gradient = grid_sample(self.gradient, self._grid(pixels), align_corners=True)[0].transpose(0, 1)
        (xx, xy), (_, yy) = (gradient @ gradient.mT / gradient.shape[2]).permute(1, 2, 0)
        textured = _least_eigenvalue(xx, xy, yy) >= _MIN_EIGENVALUE
        unit = self.scale.pixel / gradient.shape[2] * textured
        inverse = torch.stack([yy, -xy, -xy, xx]) * (unit / (xx * yy - xy * xy).clamp(min=_MIN_EIGENVALUE**2))
        return _Templates(self.values(pixels), inverse.view(2, 2, -1).permute(2, 0, 1) @ gradient, textured)

    def _grid(self, pixels: torch.Tensor) -> torch.Tensor:
        """Return the pixels of the windows round `pixels` as grid_sample takes them: (1, N, P, 2)."""
        return torch.addcmul(self.scale.window, pixels[:, None], self.scale.per_pixel)[None]


class _Constants:
    """What does not change between pictures of a size, on a device."""

    def __init__(self, height: int, width: int, device: str) -> None:
        self._device = device
        self._luma = self._tensor(LUMA)
        self.sobel, self._scharr = (self._gradient_kernels(*kernels) for kernels in (_SOBEL, _SCHARR))
        self.last_pixel = self._tensor([width - 1, height - 1])
        # As matrices: two products of them are all that a separable filter takes, be it as wide as this one.
        gaussian = cv2.getGaussianKernel(int(8 * STRUCTURE_SIGMA) + 1, STRUCTURE_SIGMA)[:, 0]
        self._smoothing = self._filter(height, width, gaussian, 1)
        self._scales = [self._scale(height, width, 1)]
        self._halvings = []
        # The coarsest level is larger than the window, as OpenCV's.
        for level in range(1, MAX_LEVEL + 1):
            halved = (height + 1) // 2, (width + 1) // 2
            if min(halved) <= WINDOW:
                break
            self._halvings.append(self._filter(height, width, _HALVING_KERNEL, 2))
            height, width = halved
            self._scales.append(self._scale(height, width, 2**level))

    def gray(self, image: Array) -> torch.Tensor:
        """Return the brightness (H, W), whole numbers as OpenCV's, of an RGB image (H, W, 3) uint8."""
        return (to_device(image, self._device).float() @ self._luma).round()

    def pyramid(self, gray: torch.Tensor) -> list[_Level]:
        """Return the local structure (common/local_structure.py) of brightness (H, W), and its halvings."""
        rows, columns = self._smoothing
        centred = gray - rows @ gray @ columns
        contrast = (rows @ centred.square() @ columns).sqrt()
        structure = STRUCTURE_GAIN * centred / contrast.clamp(min=STRUCTURE_MIN_CONTRAST)
        images = [structure.clamp(-_MAX_STRUCTURE, _MAX_STRUCTURE)]
        for rows, columns in self._halvings:
            images.append(rows @ images[-1] @ columns)
        return [
            _Level(image[None, None], _filtered(image, self._scharr), scale)
            for image, scale in zip(images, self._scales, strict=True)
        ]

    def _tensor(self, array: object) -> torch.Tensor:
        return torch.tensor(np.asarray(array), dtype=torch.float32, device=self._device)

    def _gradient_kernels(self, smoothing: Sequence[float], derivative: Sequence[float]) -> torch.Tensor:
        return self._tensor([[np.outer(smoothing, derivative)], [np.outer(derivative, smoothing)]])

    def _filter(self, height: int, width: int, kernel: np.ndarray, stride: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return what an image is multiplied with from the left and from the right to be filtered both ways."""
        rows, columns = (_filter_matrix(size, kernel, stride) for size in (height, width))
        return self._tensor(rows), self._tensor(columns.T)

    def _scale(self, height: int, width: int, pixel: int) -> _Scale:
        x, y = np.meshgrid(*(np.arange(size) - size // 2 for size in (WINDOW, WINDOW)))
        unit = 2 / np.maximum([width - 1, height - 1], 1)
        window = np.column_stack([x.ravel(), y.ravel()]) * unit - 1
        return _Scale(pixel, self._tensor(window), self._tensor(unit / pixel))


# Photos of a camera have one size.
_constants = functools.lru_cache(maxsize=4)(_Constants)


def _filter_matrix(size: int, kernel: np.ndarray, stride: int) -> np.ndarray:
    """Return the matrix that filters `size` numbers, reflected at the ends, and keeps every `stride`-th."""
    sources = np.pad(np.arange(size), len(kernel) // 2, mode="reflect")
    targets = np.arange(0, size, stride)
    matrix = np.zeros((len(targets), size))
    for k, weight in enumerate(kernel):
        np.add.at(matrix, (np.arange(len(targets)), sources[targets + k]), weight)
    return matrix


def _filtered(image: torch.Tensor, kernels: torch.Tensor) -> torch.Tensor:
    """Filter an image (H, W) with each of the K 3x3 kernels (K, 1, 3, 3): (1, K, H, W)."""
    padded = pad(image[None, None], (1, 1, 1, 1), mode="replicate")
    # With as many groups as channels torch convolves in full float32, where cuDNN would round to TF32.
    return conv2d(padded.expand(-1, len(kernels), -1, -1), kernels, groups=len(kernels))


def _least_eigenvalue(xx: torch.Tensor, xy: torch.Tensor, yy: torch.Tensor) -> torch.Tensor:
    """Return the least eigenvalues of the symmetric matrices [[xx, xy], [xy, yy]]."""
    return 0.5 * (xx + yy - torch.hypot(xx - yy, 2 * xy))
