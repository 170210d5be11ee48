"""SIFT (Lowe, 2004) in torch, for images that are on a GPU, with the RootSIFT descriptor.

It follows OpenCV's: the same scale space, the same tests, the same order of the descriptor's numbers. Every step is one
operation on all keypoints of all octaves, for which two things are simpler: gradients are sampled on a grid that grows
and turns with the keypoint instead of at each pixel, and a keypoint has at most two orientations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch.nn import functional

from gsfeatloc_ros.common.arrays import Array, to_device
from gsfeatloc_ros.match.base import Features, Matches
from gsfeatloc_ros.match.nearest import match_mutual
from gsfeatloc_ros.match.sift import MAX_DISTANCE_RATIO, MAX_TURN, MIN_CONTRAST
from gsfeatloc_ros.match.tensor import LUMA

# Scale space: the image, enlarged twofold, has the first blur; every octave begins at the second and doubles it in so
# many layers. Three images more are needed for the differences below and above those.
_IMAGE_SIGMA = 1.0
_SIGMA = 1.6
_LAYERS = 3
_BLURS = _LAYERS + 3
_BLUR_RADIUS = 20  # of the blurs, four deviations of the widest

# Extrema: contrast in gray levels; ratio of the principal curvatures of an edge; pixels of the octave.
_MIN_GRAY_CONTRAST = MIN_CONTRAST * 255 / _LAYERS
_MAX_EDGE_RATIO = 10.0
_OCTAVE_BORDER = 5
# How many are refined for each feature that is wanted, as many turn out to be edges, and how often they are moved.
_CANDIDATES_PER_FEATURE = 4
_MAX_MOVES = 2

# Orientation: the gradients in a Gaussian window of 1.5 scales, seen to three deviations.
_WINDOW_SIGMA = 1.5
_WINDOW_SAMPLES = 15
_WINDOW_BINS = 36
_MIN_PEAK_RATIO = 0.8
# Added up as whole numbers of this many gray levels: a GPU adds in any order, and sums of floats would differ.
_GRADIENT_UNIT = 1e-4

# Descriptor: 4x4 cells of three scales; gradients within half a cell round them count.
_CELLS = 4
_CELL_SIZE = 3.0
_CELL_BINS = 8
_CELL_SAMPLES = 3
_MAX_COMPONENT = 0.2

# Steps (27, 3) in x, y and layer from a voxel of the scale space to those round it.
_NEIGHBOUR_STEPS = np.array([(x, y, layer) for layer in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1)])


@dataclass(frozen=True, eq=False)
class _Atlas:
    """Where the octaves of an image are in one picture (H, W), which holds them all: the first left, the others right.

    Attributes:
        shape: H, W.
        slices: of each octave, its rows and columns.
        corners: (O, 2) float32 x, y of each octave's first pixel, and
        far_corners: of its last.
        spacing: (O, 1) float32 distance between its pixels in the image.
        octave: (H * W,) int64, of each pixel.
        inside: (LAYERS + 2, H, W) bool, where a difference of Gaussians may be extreme.
        interior: (H, W) float32, 1 where a pixel has neighbours in its octave, else 0.
        neighbours: (27,) int64 distances of a voxel of the differences, flattened, to those round it.
        strides: (3,) int64 the same of x, y and the layer.
        to_grid: (2,) float32 by which grid_sample takes pixels of the LAYERS gradient pictures, one below the other.
    """

    shape: tuple[int, int]
    slices: list[tuple[slice, slice]]
    corners: torch.Tensor
    far_corners: torch.Tensor
    spacing: torch.Tensor
    octave: torch.Tensor
    inside: torch.Tensor
    interior: torch.Tensor
    neighbours: torch.Tensor
    strides: torch.Tensor
    to_grid: torch.Tensor

    @staticmethod
    def of(height: int, width: int, device: str) -> _Atlas:
        """Make the atlas for images of this size; without octaves where it is too small for any."""
        sizes = []
        height, width = 2 * height - 1, 2 * width - 1
        while min(height, width) > 2 * _OCTAVE_BORDER:
            sizes.append((height, width))
            height, width = (height + 1) // 2, (width + 1) // 2
        origins, below = [(0, 0)], 0
        for size in sizes[1:]:
            origins.append((below, sizes[0][1]))
            below += size[0]
        slices = [
            (slice(y, y + rows), slice(x, x + columns)) for (y, x), (rows, columns) in zip(origins, sizes, strict=False)
        ]
        rows, columns = (max((place[axis].stop for place in slices), default=0) for axis in (0, 1))
        shape = (rows, columns)
        octave = np.zeros(shape, np.int64)
        inside = np.zeros((_LAYERS + 2, *shape), bool)
        interior = np.zeros(shape, np.float32)
        for index, place in enumerate(slices):
            octave[place] = index
            inside[1:-1][:, *place][:, _OCTAVE_BORDER:-_OCTAVE_BORDER, _OCTAVE_BORDER:-_OCTAVE_BORDER] = True
            interior[place][1:-1, 1:-1] = 1
        strides = np.array([1, shape[1], shape[0] * shape[1]])
        corners = np.array([[x.start, y.start] for y, x in slices], np.float32).reshape(-1, 2)
        far_corners = np.array([[x.stop - 1, y.stop - 1] for y, x in slices], np.float32).reshape(-1, 2)
        arrays = (
            corners,
            far_corners,
            2.0 ** (np.arange(len(slices), dtype=np.float32)[:, None] - 1),
            octave.ravel(),
            inside,
            interior,
            _NEIGHBOUR_STEPS @ strides,
            strides,
            2 / (np.array([shape[1], _LAYERS * shape[0]], np.float32) - 1),
        )
        return _Atlas(shape, slices, *(to_device(array, device) for array in arrays))


@dataclass(frozen=True, eq=False)
class _Keypoints:
    """Extrema of the scale space.

    Attributes:
        pixels: (N, 2) float32 in the image.
        places: (N, 2) float32 in the gradient pictures.
        near, far: (N, 2) float32 corners there of the octave, beyond which is another.
        sigma: (N, 1) float32 scale in pixels of the octave.
        scores: (N,) float32 contrast in gray levels, 0 of what is none.
    """

    pixels: torch.Tensor
    places: torch.Tensor
    near: torch.Tensor
    far: torch.Tensor
    sigma: torch.Tensor
    scores: torch.Tensor

    def select(self, index: torch.Tensor) -> _Keypoints:
        """Return the keypoints that indices (M,) name."""
        return _Keypoints(*(getattr(self, field.name)[index] for field in fields(self)))


class GpuSift:
    """SIFT features, matched by mutual nearest neighbours and the ratio test. Needs no weights."""

    upright = False

    def __init__(self, max_features: int, device: str) -> None:
        """Prepare constants on `device`, which is torch's; what is found stays there."""
        self._max_features = max_features
        self._device = device

        def constant(values: ArrayLike) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self._luma = constant(LUMA)
        self._first_blur, self._blur = (constant(_blur_kernels(sigma)) for sigma in (_IMAGE_SIGMA, _SIGMA))
        self._derivatives = constant(_derivatives())
        offsets, weights = _window()
        self._window_offsets, self._window_weights = constant(offsets), constant(weights / _GRADIENT_UNIT)
        self._smoothing = constant(_smoothing())
        offsets, weights = _cells()
        self._cell_offsets, self._cell_weights = constant(offsets), constant(weights)
        self._cell_bins = constant(np.arange(_CELL_BINS)[:, None])
        # A camera has one size of photos, and the search a smaller one.
        self._atlas = lru_cache(maxsize=4)(lambda height, width: _Atlas.of(height, width, device))

    @torch.inference_mode()
    def features(self, image: Array) -> Features:
        """Extract the features of an RGB image (H, W, 3) uint8: tensors on the device, the strongest first."""
        atlas = self._atlas(*image.shape[:2])
        if not atlas.slices:
            return self._none()
        gray = to_device(image, self._device).float() @ self._luma
        gaussians = self._gaussians(gray, atlas)
        keypoints = self._find(gaussians[1:] - gaussians[:-1], atlas)
        gradients = _gradients(gaussians[1 : _LAYERS + 1], atlas)
        keypoints, angles = self._orient(keypoints, gradients, atlas)
        if len(angles) == 0:
            return self._none()
        descriptors = self._describe(keypoints, angles, gradients, atlas)
        return Features(keypoints.pixels, descriptors, keypoints.scores, angles=angles)

    def match(self, a: Features, b: Features, same_way_up: bool = False) -> Matches:
        """Match the features of two images, of two that are the `same_way_up` those that are turned alike."""
        return match_mutual(a, b, max_ratio=MAX_DISTANCE_RATIO, max_turn=MAX_TURN if same_way_up else math.pi)

    def _none(self) -> Features:
        return Features(
            *(torch.empty(shape, device=self._device) for shape in ((0, 2), (0, _CELLS**2 * _CELL_BINS), 0))
        )

    def _gaussians(self, gray: torch.Tensor, atlas: _Atlas) -> torch.Tensor:
        """Blur the brightness of the image to all octaves: (BLURS, H, W) of the atlas."""
        first = atlas.slices[0]
        size = [place.stop for place in first]
        # Aligned at the corners, and of an odd size: the pixels of the image stay where they are, at even ones.
        octave = _blur(
            functional.interpolate(gray[None, None], size, mode="bilinear", align_corners=True), self._first_blur
        )
        gaussians = octave.new_zeros((_BLURS, *atlas.shape))
        gaussians[:, *first] = octave
        for place in atlas.slices[1:]:
            octave = _blur(octave[None, _LAYERS : _LAYERS + 1, ::2, ::2], self._blur)
            gaussians[:, *place] = octave
        return gaussians

    def _find(self, differences: torch.Tensor, atlas: _Atlas) -> _Keypoints:
        """Find the extrema of differences of Gaussians (LAYERS + 2, H, W), the strongest first."""
        # Bright and dark ones: maxima of the differences and of their negatives.
        signed = torch.stack([differences, -differences])
        highest = functional.max_pool2d(signed, 3, stride=1, padding=1)
        below, same, above = (highest[:, layer : layer + _LAYERS] for layer in range(3))
        middle = signed[:, 1:-1]
        extreme = (
            (middle == same.maximum(below).maximum(above)) & (middle > 0.5 * _MIN_GRAY_CONTRAST) & atlas.inside[1:-1]
        )
        strength = torch.where(extreme, middle, 0.0).amax(dim=0).flatten()
        strength, start = strength.topk(min(_CANDIDATES_PER_FEATURE * self._max_features, len(strength)))
        width, area = atlas.shape[1], atlas.shape[0] * atlas.shape[1]
        # What is none is sent to the first pixel that has all its neighbours.
        start = torch.where(strength > 0, start, _OCTAVE_BORDER * width + _OCTAVE_BORDER) + area
        voxel, offset, contrast, good = self._refine(differences.flatten(), start, atlas)
        # One that moved to the place of another is that one.
        valid = good & (strength > 0) & ((voxel == start) | ~extreme.any(dim=0).flatten()[voxel - area])
        scores, strongest = torch.where(valid, contrast, 0.0).topk(min(self._max_features, len(contrast)))
        voxel, offset = voxel[strongest], offset[strongest]

        layer, pixel = voxel // area, voxel % area
        octave = atlas.octave[pixel]
        place = torch.stack([pixel % width, pixel // width], dim=1) + offset[:, :2]
        corner, far_corner = atlas.corners[octave], atlas.far_corners[octave]
        down = functional.pad((layer[:, None] - 1.0) * atlas.shape[0], (1, 0))
        return _Keypoints(
            pixels=(place - corner) * atlas.spacing[octave],
            places=place + down,
            near=corner + down,
            far=far_corner + down,
            sigma=_SIGMA * torch.exp2((layer[:, None] + offset[:, 2:]) / _LAYERS),
            scores=scores,
        )

    def _refine(
        self, differences: torch.Tensor, voxel: torch.Tensor, atlas: _Atlas
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Move voxels (N,) to the extrema of the quadratics round them (Brown and Lowe, 2002).

        Returns:
            Voxels (N,), offsets (N, 3) in x, y and layer from them, contrasts (N,), and which are good keypoints (N,).
        """
        inside = atlas.inside.flatten()
        offset, derivatives = self._fit(differences, voxel, atlas)
        for _ in range(_MAX_MOVES):
            moved = voxel + (offset.nan_to_num(0.0).clamp(-1, 1).round().long() * atlas.strides).sum(dim=1)
            voxel = torch.where(inside[moved], moved, voxel)
            offset, derivatives = self._fit(differences, voxel, atlas)
        contrast = (differences[voxel] + 0.5 * (derivatives[:, :3] * offset).sum(dim=1)).abs()
        xx, xy, yy = derivatives[:, 3], derivatives[:, 4], derivatives[:, 7]
        sharp = (xx + yy) ** 2 * _MAX_EDGE_RATIO < (_MAX_EDGE_RATIO + 1) ** 2 * (xx * yy - xy**2)
        good = sharp & (contrast >= _MIN_GRAY_CONTRAST) & (offset.abs() < 0.5).all(dim=1)
        return voxel, torch.where(good[:, None], offset, 0.0), contrast, good

    def _fit(self, differences: torch.Tensor, voxel: torch.Tensor, atlas: _Atlas) -> tuple[torch.Tensor, torch.Tensor]:
        """Return offsets (N, 3) from voxels to their quadratics' extrema; gradients and Hessians (N, 3 + 9)."""
        derivatives = differences[voxel[:, None] + atlas.neighbours] @ self._derivatives
        gradient, hessian = derivatives[:, :3], derivatives[:, 3:].view(-1, 3, 3)
        # By Cramer's rule: torch.linalg.solve would wait to see that none is singular.
        adjugate = torch.linalg.cross(hessian.roll(-1, 1), hessian.roll(-2, 1))
        determinant = (hessian[:, 0] * adjugate[:, 0]).sum(dim=1, keepdim=True)
        return -(adjugate @ gradient[..., None])[..., 0] / determinant, derivatives

    def _orient(self, keypoints: _Keypoints, gradients: torch.Tensor, atlas: _Atlas) -> tuple[_Keypoints, torch.Tensor]:
        """Return the keypoints that there are, once for each orientation, and those (N,): radians from x to y."""
        places = keypoints.places[:, None] + keypoints.sigma[:, None] * self._window_offsets
        strength, angle = _sample(gradients, places, keypoints, atlas)
        bins = (angle * (_WINDOW_BINS / math.tau)).round().long().remainder(_WINDOW_BINS)
        sums = torch.zeros((len(bins), _WINDOW_BINS), dtype=torch.int32, device=bins.device)
        sums.scatter_add_(1, bins, (strength * self._window_weights).int())
        histogram = sums.float() @ self._smoothing
        before, after = histogram.roll(1, 1), histogram.roll(-1, 1)
        peaks, at = torch.where((histogram > before) & (histogram > after), histogram, 0.0).topk(2)
        valid = (peaks > 0) & (peaks >= _MIN_PEAK_RATIO * peaks[:, :1]) & (keypoints.scores > 0)[:, None]
        before, after = before.gather(1, at), after.gather(1, at)
        angles = (at + 0.5 * (before - after) / (before - 2 * peaks + after)) * (math.tau / _WINDOW_BINS)
        # The one wait for the device: how many there are.
        keypoint, peak = valid.nonzero()[: self._max_features].unbind(dim=1)
        return keypoints.select(keypoint), angles[keypoint, peak]

    def _describe(
        self, keypoints: _Keypoints, angles: torch.Tensor, gradients: torch.Tensor, atlas: _Atlas
    ) -> torch.Tensor:
        """Describe keypoints turned by angles (N,): (N, 128)."""
        cos, sin = angles.cos(), angles.sin()
        axes = torch.stack([cos, sin, -sin, cos], dim=1).view(-1, 2, 2) * keypoints.sigma[..., None]
        strength, angle = _sample(gradients, keypoints.places[:, None] + self._cell_offsets @ axes, keypoints, atlas)
        # From y to x, as OpenCV's. A gradient counts for the two directions next to its own.
        direction = (angles[:, None] - angle) * (_CELL_BINS / math.tau)
        half = _CELL_BINS // 2
        apart = ((direction[:, None] - self._cell_bins + half).remainder(_CELL_BINS) - half).abs()
        weights = functional.relu(1 - apart) * strength[:, None]
        descriptors = (weights @ self._cell_weights).transpose(1, 2).flatten(1)
        descriptors = functional.normalize(descriptors).clamp(max=_MAX_COMPONENT)
        return functional.normalize(descriptors, p=1.0).sqrt()


def _blur(image: torch.Tensor, kernels: torch.Tensor) -> torch.Tensor:
    """Blur an image (1, 1, H, W) by kernels (B, 1, 1, K) along both axes: (B, H, W)."""
    # With as many groups as channels torch convolves in full float32, where cuDNN would round to TF32.
    padded = functional.pad(image, (_BLUR_RADIUS,) * 4, mode="replicate").expand(-1, _BLURS, -1, -1)
    blurred = functional.conv2d(padded, kernels, groups=_BLURS)
    return functional.conv2d(blurred, kernels.transpose(2, 3), groups=_BLURS)[0]


def _gradients(gaussians: torch.Tensor, atlas: _Atlas) -> torch.Tensor:
    """Return central differences along x and y of pictures (L, H, W), one below the other: (1, 2, L * H, W).

    They are 0 at the borders of octaves and beyond.
    """
    gradients = gaussians.new_zeros((2, *gaussians.shape))
    gradients[0, :, :, 1:-1] = gaussians[:, :, 2:] - gaussians[:, :, :-2]
    gradients[1, :, 1:-1] = gaussians[:, 2:] - gaussians[:, :-2]
    return (gradients * atlas.interior).flatten(1, 2)[None]


def _sample(
    gradients: torch.Tensor, places: torch.Tensor, keypoints: _Keypoints, atlas: _Atlas
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return lengths and angles (N, S) of the gradients at places (N, S, 2) round keypoints (N)."""
    # Beyond the octave as at its border, where they are 0.
    places = places.clamp(keypoints.near[:, None], keypoints.far[:, None])
    x, y = functional.grid_sample(gradients, places[None] * atlas.to_grid - 1, align_corners=True)[0]
    return torch.hypot(x, y), torch.atan2(y, x)


def _blur_kernels(sigma: float) -> np.ndarray:
    """Return the Gaussians (BLURS, 1, 1, K) that make the images of an octave of one that has the blur `sigma`."""
    variances = (_SIGMA * 2 ** (np.arange(_BLURS) / _LAYERS)) ** 2 - sigma**2
    x = np.arange(-_BLUR_RADIUS, _BLUR_RADIUS + 1)
    kernels = np.exp(-0.5 * x**2 / np.maximum(variances, 1e-6)[:, None])
    return (kernels / kernels.sum(axis=1, keepdims=True))[:, None, None]


def _derivatives() -> np.ndarray:
    """Return the matrix (27, 12) that makes gradient (3) and Hessian (3, 3) of the values (27) round a voxel."""
    axes = list(np.eye(3, dtype=int))

    def value(step: np.ndarray) -> np.ndarray:
        return (step == _NEIGHBOUR_STEPS).all(axis=1).astype(float)

    gradient = [(value(a) - value(-a)) / 2 for a in axes]
    hessian = [
        value(a) + value(-a) - 2 * value(0 * a)
        if a is b
        else (value(a + b) - value(a - b) - value(b - a) + value(-a - b)) / 4
        for a in axes
        for b in axes
    ]
    return np.column_stack(gradient + hessian)


def _window() -> tuple[np.ndarray, np.ndarray]:
    """Return where the gradients that give the orientation are, (S, 2) in scales, and their weights (S,)."""
    line = np.linspace(-3 * _WINDOW_SIGMA, 3 * _WINDOW_SIGMA, _WINDOW_SAMPLES)
    offsets = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return offsets, np.exp(-0.5 * (offsets**2).sum(axis=1) / _WINDOW_SIGMA**2)


def _smoothing() -> np.ndarray:
    """Return the circulant matrix (36, 36) that smooths a histogram of directions."""
    weights = zip(range(-2, 3), np.array([1, 4, 6, 4, 1]) / 16, strict=True)
    return np.sum([weight * np.roll(np.eye(_WINDOW_BINS), shift, axis=1) for shift, weight in weights], axis=0)


def _cells() -> tuple[np.ndarray, np.ndarray]:
    """Return where the gradients of a descriptor are, (S, 2) in scales, and their weights in its cells (S, 16)."""
    reach = _CELLS / 2 + 0.5
    count = int(2 * reach * _CELL_SAMPLES)
    line = (np.arange(count) + 0.5) / _CELL_SAMPLES - reach
    centers = np.arange(_CELLS) - (_CELLS - 1) / 2
    along_axis = np.maximum(1 - np.abs(line[:, None] - centers), 0) * np.exp(-0.5 * (line[:, None] / (_CELLS / 2)) ** 2)
    offsets = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return _CELL_SIZE * offsets, np.kron(along_axis, along_axis)
