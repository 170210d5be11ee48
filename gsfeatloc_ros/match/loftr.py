"""LoFTR (Sun et al., CVPR 2021) by kornia: matching without keypoints. Weights and code: Apache-2.0."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from kornia.color import rgb_to_grayscale
from kornia.feature import LoFTR

from gsfeatloc_ros.common.arrays import Array
from gsfeatloc_ros.match.base import Matches
from gsfeatloc_ros.match.tensor import is_blank, to_tensor
from gsfeatloc_ros.match.weights import WeightsSource, fill

_WEIGHTS = WeightsSource("loftr_outdoor.ckpt", None, lambda: {"state_dict": LoFTR("outdoor").state_dict()}, sha256="")


@dataclass(frozen=True, eq=False)
class DenseFeatures:
    """What LoFTR sees in an image.

    Attributes:
        maps: "coarse" (1, 256, H/8, W/8) and "fine" (1, 128, H/2, W/2) feature maps; None of an image of one colour.
    """

    maps: dict[str, torch.Tensor] | None

    def __len__(self) -> int:
        """Number of coarse cells, each of which can have a match."""
        return self.maps["coarse"][0, 0].numel() if self.maps else 0


class LoftrMatcher:
    """LoFTR with the weights for outdoor scenes (MegaDepth)."""

    upright = True

    def __init__(self, weights: str, max_features: int, device: str) -> None:
        """Load the network.

        Args:
            weights: path of the weights; "" for the usual places.
            max_features: most matches of two images.
            device: of torch's, on which it runs.

        Raises:
            WeightsError: the weights cannot be had or are not LoFTR's.
        """
        self._max_matches = max_features
        self._loftr = LoFTR(None)
        fill(self._loftr, _WEIGHTS.load(weights).get("state_dict", {}), "LoFTR")
        self._loftr.to(device)
        self._device = device

    @torch.inference_mode()
    def features(self, image: Array) -> DenseFeatures:
        """Compute the feature maps of an RGB image (H, W, 3) uint8."""
        if is_blank(image):
            return DenseFeatures(None)
        return DenseFeatures(self._loftr.extract_features(rgb_to_grayscale(to_tensor(image, self._device))))

    @torch.inference_mode()
    def match(self, a: DenseFeatures, b: DenseFeatures, same_way_up: bool = False) -> Matches:
        """Match two images."""
        if len(a) == 0 or len(b) == 0:
            return Matches.none()
        found = self._loftr({"features0": a.maps, "features1": b.maps})
        confidence, best = found["confidence"].sort(descending=True)
        best = best[: self._max_matches]
        # LoFTR learned from COLMAP's cameras, in whose pixels the centre of the first is (0.5, 0.5).
        pixels_a, pixels_b = (found[key][best].cpu().double().numpy() - 0.5 for key in ("keypoints0", "keypoints1"))
        return Matches(pixels_a, pixels_b, confidence[: len(best)].cpu().double().numpy())
